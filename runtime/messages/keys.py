"""The key expressions of one robot."""

from __future__ import annotations


class Keys:
    """The key expressions of one robot."""

    def __init__(self, robot: str) -> None:
        root = f"trotd/{robot}"
        self.root = root
        self.status = f"{root}/status"
        self.tick = f"{root}/tick"
        self.tick_schema = f"{root}/tick/schema"
        self.event = f"{root}/event"
        self.velocity = f"{root}/command/velocity"
        self.mode = f"{root}/command/mode"
        self.policy = f"{root}/policy"
        self.policies = f"{root}/policies"
        self.tuning = f"{root}/tuning"
        self.change_tuning = f"{root}/command/tuning"
        self.pose = f"{root}/command/pose"
        self.recording = f"{root}/recording"
        self.faults = f"{root}/faults"
        self.alive = f"{root}/alive"
        self.operator = f"{root}/operator"
        self.sim_truth = f"{root}/sim/truth"
        self.sim_push = f"{root}/sim/push"
        self.sim_hold = f"{root}/sim/hold"

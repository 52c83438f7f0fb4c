"""Drive a running trotd from any zenoh client: arm, stand up, walk forward for five seconds, sit down."""

import json
import time

import zenoh

ROBOT = "trotd/stoch3"
config = zenoh.Config()
config.insert_json5("connect/endpoints", '["tcp/127.0.0.1:7447"]')
config.insert_json5("scouting/multicast/enabled", "false")

with zenoh.open(config) as session:

    def ask(mode: str) -> None:
        for reply in session.get(f"{ROBOT}/command/mode", payload=mode):
            print(mode, json.loads(reply.ok.payload.to_string()) if reply.ok else reply.err.payload.to_string())

    ask("arm"), ask("stand"), time.sleep(5), ask("walk")
    for _ in range(100):
        session.put(f"{ROBOT}/command/velocity", json.dumps({"linear": [0.4, 0.0], "yaw_rate": 0.0}))
        time.sleep(0.05)
    ask("stand"), time.sleep(1.5), ask("sit")

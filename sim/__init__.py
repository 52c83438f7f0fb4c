"""The body in PyBullet: the simulator that stands in for the hardware behind the same verbs."""

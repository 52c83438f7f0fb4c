"""Fault injection: robots that stand and walk in the simulator, what can break on them, and what must come of it."""

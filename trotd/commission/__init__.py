"""``trotd commission``: how a robot is put together, found out step by step."""

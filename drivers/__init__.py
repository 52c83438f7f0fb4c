"""The body as software sees it: the robot's description, the types of one exchange, and the drivers."""

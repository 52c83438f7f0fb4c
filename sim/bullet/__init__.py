"""PyBullet, spoken in this package alone: the engine, the ground and the robot as it keeps them."""

"""The service on the robot: configuration, ticker, modes, guard, link, recorder and daemon."""

"""All checks before the robot moves."""

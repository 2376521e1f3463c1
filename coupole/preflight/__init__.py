"""Everything that is known before the robot moves."""

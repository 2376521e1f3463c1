"""Plans that are written for an object, and the uncertainty that they promise."""

"""Plans that are suggested for an object, with their expected uncertainty."""

"""Two states of an object compared: what changed in shape and colour, and how surely."""

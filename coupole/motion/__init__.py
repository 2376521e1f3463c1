"""Motion of the arm: bodies, collisions, paths, order of views; occlusion of LEDs."""

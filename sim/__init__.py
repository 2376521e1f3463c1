"""Stand-ins for LED box, robot and camera, at the other ends of their wires, in one simulated world."""

"""Stand-ins for LED box, robot and camera at the other end of their wires, in one simulated world."""

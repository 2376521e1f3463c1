"""The other end of the wire: stand-ins for box, robot and camera, in one simulated world."""

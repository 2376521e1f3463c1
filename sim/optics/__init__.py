"""From light on a scene to digital numbers: LEDs, lens, sensor."""

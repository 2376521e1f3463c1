"""Way from light on a scene to digital numbers: LEDs, lens, sensor."""

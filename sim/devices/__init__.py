"""The stand-ins: the simulated end of every driver's wire."""

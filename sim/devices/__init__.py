"""The other end of every driver's wire."""

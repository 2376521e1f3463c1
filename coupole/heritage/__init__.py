"""The conservator's bench: what an object is made of, and how it may have looked."""

"""Views of a measured object under lights that were not in the dome."""

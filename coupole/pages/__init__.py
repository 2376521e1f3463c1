"""The parts of all pages of results, and the templates that write them."""

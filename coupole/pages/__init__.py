"""The parts that all pages of results are made of, and the templates that write them."""

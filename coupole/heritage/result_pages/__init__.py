"""Pages that show results, stored beside the results."""

"""Pages of results, beside what they show."""

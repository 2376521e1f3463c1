"""Virtual restoration: the possible former appearance of a statue or a part of a building, by stated
hypotheses."""

"""Virtual restoration: what a statue or a part of a building may have looked like, by stated hypotheses."""

"""The commands by what they are about. Each reads its input, calls what does the work, and says how it went."""

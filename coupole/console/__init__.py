"""The operator's console: one service that owns a cell while it works, and what talks to it."""

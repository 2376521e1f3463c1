"""Rights of people at a console: accounts, sessions, control, the check of every request, the log."""

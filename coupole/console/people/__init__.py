"""Rights of people at a console: accounts, sessions, control, the guard before all requests, the log."""

"""Who may do what at a console: accounts, sessions, control, the guard before all requests, the log."""

"""What keeps a console and its people informed: notifications, facts of the system, support bundles."""

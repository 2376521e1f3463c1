"""Plans and objects: their files and forms, their preflight, the queue and what it will need."""

"""Plans and objects: their files and forms, their preflight, the queue and its outlook."""

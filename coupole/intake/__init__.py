"""Input from outside: files, each read once, and others' JSON and YAML as plain data."""

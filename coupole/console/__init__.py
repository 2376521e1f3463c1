"""The operator's console: the service that owns a cell, and its clients."""

pytest_plugins = ["coupole.testing"]

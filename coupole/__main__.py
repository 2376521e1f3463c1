"""`coupole`, and `python -m coupole`. Loads little, so that almost no Ctrl-C comes before it."""

import signal


def main() -> None:
    """Run a command. While its modules are loaded, Ctrl-C ends the process without a word: nothing is open yet."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from coupole.commands import cli

    cli.main()


if __name__ == "__main__":
    main()

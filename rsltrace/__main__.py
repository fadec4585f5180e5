"""``python -m rsltrace``."""

from rsltrace.cli.start import main

if __name__ == "__main__":
    main()

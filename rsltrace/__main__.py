"""``python -m rsltrace``."""

from rsltrace.cli.main import main

if __name__ == "__main__":
    main()

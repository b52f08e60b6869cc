"""Entry point of ``python -m flexid_cli``."""

from flexid_cli.cli.main import main

if __name__ == "__main__":
    main()

"""`python -m jscomb` is the command `jscomb`."""

from jscomb.cli import main

if __name__ == "__main__":
    main()

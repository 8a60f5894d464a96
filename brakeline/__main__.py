"""Run the command line as `python -m brakeline`."""

from brakeline.deploy.cli import main

if __name__ == "__main__":
    raise SystemExit(main())

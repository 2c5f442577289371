"""``python -m hybrid_mpc``: the command line, where the script `hybrid-mpc` is not on the path."""

from hybrid_mpc.cli.main import main

if __name__ == "__main__":
    main()

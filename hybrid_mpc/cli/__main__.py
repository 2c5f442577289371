"""``python -m hybrid_mpc.cli``: the command line without its script."""

from hybrid_mpc.cli.main import main

if __name__ == "__main__":
    main()

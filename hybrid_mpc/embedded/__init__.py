"""The controller as self-contained C: generated from a kit, or run from Python behind the same interface."""

"""Runs: stages in a folder, each computed only where what it reads has changed, and the commands made of them."""

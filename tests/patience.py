"""How long a test waits for another process."""

HANGS = 900.0
"""What is not there by then [s] never comes. It ends a test that hangs; a machine on which a process that takes seconds
takes longer is not merely loaded."""

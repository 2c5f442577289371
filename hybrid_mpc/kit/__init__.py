"""The artifact: the folder that holds all that a loop needs, and the parts made from it."""

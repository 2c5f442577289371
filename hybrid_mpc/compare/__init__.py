"""Closed loops compared: controllers by name, loops, intervals, studies, what a kit promises."""

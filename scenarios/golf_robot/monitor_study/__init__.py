"""The study of the guard on the golf robot: what it learns from, what it finds, how soon."""

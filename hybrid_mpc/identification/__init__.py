"""The offline half: from trajectories to a fitted prior and trained networks (torch).

Import from its modules: ``prior_fit``, ``networks``, ``cells``, ``step``, ``objectives``, ``combination``,
``training``, ``search``, ``evaluation``, ``export``. The package itself imports nothing, so that torch loads only when
needed.
"""

"""``benchmark``: a machine's models judged by free runs over recordings that none of them has seen.

``recordings`` cuts and splits, ``physics`` fits the prior with its delay, ``networks`` trains, ``free_runs`` judges,
``store`` keeps a finished model, ``job`` puts them in order.
"""

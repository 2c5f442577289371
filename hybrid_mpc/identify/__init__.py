"""From trajectories to a fitted prior and trained networks. The one room that trains with torch."""

"""An arm in a simulated scene that is taken by the hand, shown a task, and watched while it does it."""

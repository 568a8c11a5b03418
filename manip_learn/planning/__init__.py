"""Plans: in which posture to take hold, and how to get there, so that the whole way can be done."""

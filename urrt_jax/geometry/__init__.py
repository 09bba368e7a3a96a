"""Point clouds with masks, rigid transforms and neighbour queries: the ground floor, which imports nothing above it."""

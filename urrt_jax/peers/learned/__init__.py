"""Learned peers: the networks of other papers in Flax, with their losses, and readers of their released weights."""

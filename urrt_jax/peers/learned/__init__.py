"""Learned peers: the networks of other papers in Flax, with their losses and their authors' released weights."""

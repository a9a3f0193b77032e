"""Learned dynamics of a cable: its graph, networks, training, evaluation and weights."""

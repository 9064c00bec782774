"""Helpers shared by tests: labs, rigs, clients, networks and recordings for them."""

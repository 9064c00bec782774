"""Typed publishers and subscribers, batches of messages of many rigs, and recording streams."""

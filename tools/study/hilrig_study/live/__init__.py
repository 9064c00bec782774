"""Studies on running rigs, and studies based on the latency of a recording."""

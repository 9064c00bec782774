"""Monitoring of a running lab: service reports combined, for `top`, the console and Prometheus."""

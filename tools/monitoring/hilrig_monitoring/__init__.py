"""Monitoring of a running lab: combines health reports for `hilrig top`, the console and Prometheus."""

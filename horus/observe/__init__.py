"""Metrics of a scheduler, for applications and for telemetry endpoints."""

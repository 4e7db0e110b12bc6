"""Logs as machines write them: topics with clocks of their own, brought to one uniform grid."""

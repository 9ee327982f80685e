"""`tauext demo`: push a simulated arm and see what the monitor makes of it."""

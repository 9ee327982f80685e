"""Leader and follower of benchmarks/feeling.py."""

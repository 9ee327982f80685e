"""Bundles as files and in words, of the standard library and the core alone, so that `tauext show` answers at once."""

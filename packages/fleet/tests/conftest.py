"""A small object store for the tests of this package."""

import pytest
from made_s3 import s3_environment, s3_server


@pytest.fixture
def s3(monkeypatch, tmp_path, own_cache):
    """A server without objects. The scratch folder is of one test, findings are of all."""
    for folder in (tmp_path / "cache/tauext", own_cache / "tauext/checks"):
        folder.mkdir(parents=True, exist_ok=True)
    (tmp_path / "cache/tauext/checks").symlink_to(own_cache / "tauext/checks")
    with s3_server() as server:
        for name, value in s3_environment(server.port).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("TAUEXT_STORE_STALL_S", "60")  # no machine is so slow
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        yield server

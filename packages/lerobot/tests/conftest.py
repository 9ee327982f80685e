"""The simulated servos of tauext's own tests, and a bundle of theirs."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """A folder with arm.tauext and arm.toml."""
    import lerobot_arm as arms

    import tauext
    from tauext.data.importing import import_dataset

    folder = tmp_path_factory.mktemp("trained")
    (folder / "arm.toml").write_text(arms.ARM.replace("UNIT", "deg"))
    arms.write_dataset(folder / "free", arms.episodes(range(6), 1200), "v3.0")
    import_dataset([folder / "free"], folder / "arm.toml", folder / "data", "tauext", lambda _: None)
    config = tauext.TrainConfig(recipe="prior")
    tauext.train_bundle(tauext.load_dataset(folder / "data"), folder / "arm.tauext", config=config, check=False)
    return folder

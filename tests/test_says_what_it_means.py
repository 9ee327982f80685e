"""The command line says which version it is, what it replaces, and joints in the arm's order."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
from made_bundles import cut_flight, pushed, watching_bundle
from tauext_lab.report.flight import draw_close
from tauext_lab.report.flight_file import load_flight
from tauext_lab.report.style import uncertainty_words

from tauext import _core
from tauext.bundle.estimates import load_estimates
from tauext.cli import main
from tauext.cli.show import in_order
from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import save_recording
from tauext.monitor.estimate import estimate_recording
from tauext.monitor.flight_files import FlightSource, write_flight


def test_the_version_names_package_core_and_bundle_format(capsys):
    assert main(["--version"]) == 0
    said = capsys.readouterr().out
    built = rf"core {_core.__version__} by (gcc|.*[Cc]lang) \d+\.\d+\.\d+ with (sse2|avx2|avx512|neon), "
    assert re.search(built, said)
    assert said.endswith("bundle format 1\n")


def test_results_that_are_there_are_replaced_with_a_word(tmp_path, capsys):
    names = [f"made-{k}" for k in range(4)]
    for k, name in enumerate(names):
        save_recording(pushed(name, pushes=((2.0, k % 2, 5.0),)), tmp_path / f"{name}.parquet")
    save_split(Split(*([f"{name}.parquet"] for name in names)), tmp_path)
    watching_bundle().save(str(tmp_path / "one.tauext"))
    out = tmp_path / "out"
    command = ["evaluate", "--data", str(tmp_path), "--bundles", str(tmp_path / "one.tauext"), "--out", str(out)]
    assert main(command) == 0
    assert "replaced" not in capsys.readouterr().err
    (out / "results.json").write_text("old")
    assert main(command) == 0
    told = capsys.readouterr()
    assert f"{out / 'results.json'} already exists and will be replaced" in told.err and "replaced" not in told.out
    assert json.loads((out / "results.json").read_text())["format"] == 1


def test_show_keeps_the_arm_s_order_of_joints(tmp_path, capsys):
    bundle = watching_bundle()  # shoulder, then elbow
    bundle.provenance = json.dumps({"gate": {"elbow": "no network", "shoulder": "network"}}, sort_keys=True)
    bundle.save(str(tmp_path / "one.tauext"))
    assert main(["show", str(tmp_path / "one.tauext")]) == 0
    said = capsys.readouterr().out
    assert said.index("network of shoulder") < said.index("network of elbow")
    names = [f"joint{k}" for k in range(1, 12)]
    by_alphabet = {"friction": {name: {} for name in sorted(names)}}
    assert list(in_order(by_alphabet, names)["friction"]) == names


def test_a_flight_without_a_network_says_so_and_draws_what_there_is(tmp_path):
    bundle, samples = watching_bundle(network=False), pushed()
    said = _core.Monitor(bundle).run(samples.t_ns, samples.q, samples.dq, samples.tau)
    flight = cut_flight(bundle, samples, int(np.flatnonzero(said["alarm"] == 2)[0]))
    flight["prior"] = flight["prior"] + 0.5  # as a prior would say
    source = FlightSource.of(bundle, samples)
    plain = load_estimates(write_flight(flight, tmp_path, source).with_suffix(".estimates.parquet"))
    assert uncertainty_words([plain]) == "nothing learned"
    loaded = load_flight(write_flight(flight, tmp_path, replace(source, lacking=source.lacking - {"prior"})))
    assert uncertainty_words([loaded.estimates]) == "prior"
    figure = draw_close(loaded).figure
    assert "prior" in [text.get_text() for text in figure.legends[0].get_texts()]
    learned = figure.axes[1].get_lines()[1].get_ydata()
    np.testing.assert_allclose(learned[np.isfinite(learned)], 0.5)


def test_a_contact_s_flight_is_drawn_with_the_contact_limit(tmp_path):
    bundle, samples = watching_bundle(), pushed()
    said = _core.Monitor(bundle).run(samples.t_ns, samples.q, samples.dq, samples.tau)
    row = int(np.flatnonzero(said["alarm"] == 1)[0])
    loaded = load_flight(write_flight(cut_flight(bundle, samples, row), tmp_path, FlightSource.of(bundle, samples)))
    assert loaded.limit_level == "contact"
    np.testing.assert_allclose(2 * loaded.limit_nm, loaded.estimates.limit_nm)  # as watching_bundle's contacts have it


def test_the_first_estimates_are_nan_and_say_why():
    samples = pushed()
    estimates = estimate_recording(watching_bundle(), samples, 1)
    assert np.isnan(estimates.tau_ext[0]).all() and estimates.why(0) == "warming up"
    first = int(np.flatnonzero(estimates.healthy)[0])
    assert estimates.why(first - 1) == "warming up" and estimates.why(first) == "ok"
    assert np.isfinite(estimates.tau_ext[first]).all()

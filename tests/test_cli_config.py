"""Configuration on the command line: which source wins, and printing what is read back."""

from __future__ import annotations

from command_line import call

from geomoe3d.config import RegistrationConfig


def test_options_reach_the_registrar_and_win_over_set_and_file(tmp_path, scan_files, fake_registrar):
    path = tmp_path / "my.yaml"
    path.write_text("seed: 1\nvoxel_size: 0.5\nmatching: {name: mutual}\n")
    code = call(
        *(
            "register",
            *scan_files,
            "--config",
            path,
            "--set",
            "seed=2",
            "--set",
            "estimator.inlier_threshold=3",
        ),
        *("--seed", "3", "--filter", "spectral", "--estimator", "ransac"),
    )
    assert code == 0
    ((source, target, config),) = fake_registrar.asked
    assert [source, target] == scan_files
    assert (config.seed, config.voxel_size, config.matching.name) == (3, 0.5, "mutual")
    assert (config.filter.name, config.estimator.name) == ("spectral", "ransac")
    assert config.estimator.inlier_threshold == 3


def test_config_prints_what_register_reads(tmp_path, scan_files, fake_registrar, capsys):
    assert call("config", "--set", "seed=9") == 0
    text = capsys.readouterr().out
    path = tmp_path / "config.yaml"
    assert call("config", "--set", "seed=9", "--output", path) == 0
    assert path.read_text() == text
    assert call("config", "--output", path) == 2  # it exists
    assert path.read_text() == text
    assert call("register", *scan_files, "--config", path) == 0
    assert fake_registrar.asked[0][2] == RegistrationConfig(seed=9)

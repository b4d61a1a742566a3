"""Where published recordings are looked for."""

import pytest

from diffsim.data import find_dataset


def test_find_dataset_never_falls_back_when_asked(tmp_path, monkeypatch):
    (tmp_path / "silicone_beam").mkdir()
    (tmp_path / "silicone_beam" / "metadata.yaml").write_text("{}")
    assert find_dataset("silicone_beam", tmp_path) == tmp_path / "silicone_beam"
    assert find_dataset("silicone_beam", tmp_path / "silicone_beam") is not None
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path))
    assert find_dataset("silicone_beam") == tmp_path / "silicone_beam"
    with pytest.raises(FileNotFoundError, match=r"silicone_beam; did you mean 'silicone_beam'"):
        find_dataset("silicon_beam")
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match=r"DIFFSIM_DATA=.*nowhere .* does not exist"):
        find_dataset("silicone_beam")

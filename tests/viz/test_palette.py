"""Small PNGs."""

from tests.optional import needs

needs("matplotlib")


def test_png_has_a_palette_replaces_the_old_one_and_closes_the_figure(tmp_path):
    from matplotlib import pyplot as plt
    from PIL import Image

    from diffsim.viz.palette import save

    path = tmp_path / "made" / "line.png"
    for _ in range(2):
        figure, axes = plt.subplots(figsize=(2, 1))
        axes.plot([0, 1], color="#c2571a")
        assert save(figure, path, dpi=50) == path
        assert not plt.fignum_exists(figure.number)
    with Image.open(path) as picture:
        assert (picture.mode, picture.size) == ("P", (100, 50))
    assert [p.name for p in path.parent.iterdir()] == ["line.png"]

"""Names that the font cannot write."""

import warnings

from hybrid_mpc.plots.style import new_figure, save


def test_a_character_that_the_font_lacks_warns_of_nothing(tmp_path):
    figure, _ = new_figure(1, 1)
    figure.suptitle("\x1b[2J 名 \u202e")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert save(figure, tmp_path / "a.png").stat().st_size > 100

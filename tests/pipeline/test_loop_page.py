"""The page of the closed loop: a learned curve is drawn over its covariate, with units."""

from __future__ import annotations

from pipeline.report.loop import curve


def test_a_learned_curve_is_drawn_with_its_units() -> None:
    figure = curve(
        {"covariate": [0.0, 1e-5], "path": [0.0, 2e-9]}, {"covariate": "m", "path": "m"}, "learned:path by OPD"
    )
    assert figure.layout.xaxis.title.text == "OPD [m]"
    assert figure.layout.yaxis.title.text == "path [m]"
    assert list(figure.data[0].y) == [0.0, 2e-9]
    two = {"covariate": [0.0, 1.0], "row_px": [0.0, 0.1], "column_px": [0.1, 0.0]}
    units = {"covariate": "", "row_px": "px", "column_px": "px"}
    figure = curve(two, units, "learned:attitude")
    assert figure.layout.xaxis.title.text == "attitude" and [t.name for t in figure.data] == ["row", "column"]
    assert figure.layout.yaxis.title.text == "row [px], column [px]"

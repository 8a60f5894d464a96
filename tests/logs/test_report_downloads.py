"""Figures of the report are saved as SVG and their data as CSV."""

import csv
import io
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.browser import Page


def test_figures_and_their_data_are_saved(page: Page, report: tuple[Path, dict[str, Any]]) -> None:
    page.value("window.save = (name, kind, text) => { window.saved = { name, kind, text }; }")
    buttons = "document.querySelector('[data-robot=ground] [data-chart=\"goals reached\"] .saves').children"
    page.value(f"{buttons}[0].click()")
    saved = page.value("saved")
    picture = ElementTree.fromstring(saved["text"])
    assert saved["name"] == "goals-reached.svg" and picture.tag == "{http://www.w3.org/2000/svg}svg"
    words = [text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert "goals reached [share of episodes]" in words and "steps of all actors of the run" in words
    page.value(f"{buttons}[1].click()")
    saved = page.value("saved")
    rows = list(csv.DictReader(io.StringIO(saved["text"])))
    bins = [row for row in report[1]["training"]["ground"]["bins"] if row["goals"] is not None]
    raw = [float(row["raw"]) for row in rows if row["raw"]]
    assert saved["kind"] == "text/csv" and raw == pytest.approx([row["goals"] for row in bins])


def test_an_episode_is_saved_as_it_is_shown(page: Page) -> None:
    page.value("window.save = (name, kind, text) => { window.saved = { name, kind, text }; }")
    page.value("document.querySelector('#picker .course .saves').children[1].click()")
    saved = page.value("saved")
    rows = list(csv.DictReader(io.StringIO(saved["text"])))
    fact = "[...document.querySelectorAll('#episode-facts dd')].find(d => d.dataset.fact === '{}').textContent"
    assert saved["name"] == "an-episode-over-time.csv"
    assert len(rows) == int(page.value(fact.format("steps")))
    now = next(row for row in rows if row["step"] == page.value(fact.format("step")))
    assert f"{100 * float(now['clearance_m']):.3g} cm" == page.value(fact.format("clearance"))
    assert page.value(fact.format("decision")).startswith(now["decision"])
    for box in ("#picker .course", "#picker .split > div"):
        page.value(f"document.querySelector('{box} .saves').children[0].click()")
        assert ElementTree.fromstring(page.value("saved.text")).tag == "{http://www.w3.org/2000/svg}svg"

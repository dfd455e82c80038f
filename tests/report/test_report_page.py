"""The page: it needs nothing but itself, believes no file name, and is whole for every kind of run."""

from __future__ import annotations

import base64
import io
import os
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from handmade import decide, draw_image, write_images
from PIL import Image

from loopclosure.errors import TruthError
from loopclosure.evaluation import LoopLog, evaluate
from loopclosure.images.sequence import ImageSequence
from loopclosure.records import Decision, Reason
from loopclosure.report import facts, write_report

VOID = {"meta", "img", "br", "link", "input", "source"}
HOSTILE = "<script>alert(1)<svg onload=x>\"'&{{ 7*7 }}.jpg"


class Page(HTMLParser):
    """What a browser would see: tags, attributes, text, in a tree that closes."""

    def __init__(self, file) -> None:
        super().__init__()
        self.source = file.read_text(encoding="utf-8")
        self.tags, self.attributes, self.texts, self._open = [], [], [], []
        self.feed(self.source)
        self.close()
        assert not self._open, f"never closed: {self._open}"
        self.text = " ".join(" ".join(self.texts).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] != "style":
            self.texts.append(data)

    def images(self, kind):
        """Decode all embedded pictures of a kind."""
        head = f"data:image/{kind};base64,"
        sources = [value for tag, name, value in self.attributes if (tag, name) == ("img", "src")]
        return [
            Image.open(io.BytesIO(base64.b64decode(value.removeprefix(head), validate=True)))
            for value in sources
            if value.startswith(head)
        ]


def evaluated(run, truth, **settings):
    metrics, curve = evaluate(LoopLog.from_decisions(run.decisions), truth, tolerance=0, bootstrap=20, **settings)
    return {"metrics": metrics, "curve": curve, "truth": truth}


def assert_self_contained(page):
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    for tag, name, value in page.attributes:
        if name in ("src", "href", "srcset", "data", "poster", "action"):
            assert value.startswith("data:image/"), (tag, name, value[:80])
    (style,) = re.findall(r"<style>(.*?)</style>", page.source, re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style


def test_everything_is_on_one_page(drive, drive_truth):
    poses = np.c_[np.arange(40.0), np.zeros(40)]
    file = write_report(drive, **evaluated(drive, drive_truth), poses=poses)
    assert file == drive.folder / "report.html"
    page = Page(file)
    assert_self_contained(page)
    for heading in ("All pairs", "Best loops", "Worst mistakes", "Accuracy", "Path", "Decisions", "How it was made"):
        assert heading in page.text
    assert "19 loops accepted among 40 frames" in page.text
    assert "18 are right and 1 wrong" in page.text
    assert len(page.images("png")) == 3
    assert not list(drive.folder.glob("*.part"))


def test_best_loops_show_their_own_images(drive):
    page = Page(write_report(drive))
    captions = re.findall(r"(query|match), frame (\d+)", page.source)
    pictures = page.images("jpeg")
    assert len(captions) == len(pictures) == 16
    for (_, number), picture in zip(captions, pictures, strict=True):
        wanted = np.asarray(Image.fromarray(draw_image(int(number))).resize(picture.size), float)
        assert np.abs(np.asarray(picture, float) - wanted).mean() < 12
        assert max(picture.size) == 320
    queries = sorted(int(number) for side, number in captions if side == "query")
    assert min(np.diff(queries)) >= 2


def test_without_truth_nothing_is_judged(drive):
    page = Page(write_report(drive))
    assert "Worst mistakes" not in page.text
    assert "Accuracy" not in page.text
    assert "right" not in page.text.split()
    assert "wrong" not in page.text.split()


def test_mistakes_say_what_would_have_been_right(drive, drive_truth):
    page = Page(write_report(drive, **evaluated(drive, drive_truth)))
    mistakes = page.text[page.text.index("Worst mistakes") : page.text.index("Accuracy")]
    assert "query 30" in mistakes
    assert "match 3 " in mistakes
    assert "✗ wrong" in mistakes
    assert "true match: frame 10" in mistakes


def test_no_accepted_loop_shows_the_nearest(make_run, folder, drive_truth):
    decisions = [decide(query, query - 20 if query >= 20 else None, 0.01 * query) for query in range(40)]
    run = make_run(ImageSequence(folder), decisions)
    page = Page(write_report(run, **evaluated(run, drive_truth)))
    assert "0 loops accepted among 40 frames: the best candidate scored 0.39, the threshold is 0.6." in page.text
    assert "Nearest candidates" in page.text
    assert "right, not accepted" in page.text
    assert "Worst mistakes No candidate is wrong." in page.text


def test_no_candidate_at_all(make_run, folder):
    images = ImageSequence(folder)
    run = make_run(images, [decide(query, None, None) for query in range(40)])
    page = Page(write_report(run))
    assert "no frame had a candidate" in page.text
    assert not page.images("jpeg")
    assert len(page.images("png")) == 1


def test_two_frames(make_run, tmp_path, make_truth):
    images = ImageSequence(write_images(tmp_path / "two", 2))
    run = make_run(images, [decide(0, None, None), decide(1, 0, 0.9, accepted=True)])
    page = Page(write_report(run, **evaluated(run, make_truth([(1, 0)], (2, None))), poses=np.zeros((2, 2))))
    assert "1 loop accepted among 2 frames" in page.text
    assert len(page.images("jpeg")) == 2


def test_reference_without_images(make_run, folder):
    decisions = [decide(query, query + 50, 0.7, accepted=True) for query in range(40)]
    run = make_run(ImageSequence(folder), decisions, references=None, reference="a saved/detector")
    run = replace(run, info=run.info | {"references": 100}, matrix=np.full((40, 100), 0.5, np.float32))
    page = Page(write_report(run))
    assert "images against detector" in page.text
    assert page.text.count("image not at hand") == 8
    assert len(page.images("jpeg")) == 8


def test_two_traverses_show_the_images_of_the_reference(make_run, folder, tmp_path):
    reference = ImageSequence(write_images(tmp_path / "reference", 60))
    decisions = [decide(query, query + 20, 0.7, accepted=True) for query in range(40)]
    run = make_run(ImageSequence(folder), decisions, reference="x/reference", references=reference)
    run = replace(run, info=run.info | {"references": 60}, matrix=np.full((40, 60), 0.5, np.float32))
    here, there = np.zeros((40, 2)), np.ones((60, 2))
    page = Page(write_report(run, poses=here, reference_poses=there))
    matches = [int(number) for number in re.findall(r"match, frame (\d+)", page.source)]
    for number, picture in zip(matches, page.images("jpeg")[1::2], strict=True):
        wanted = np.asarray(Image.fromarray(draw_image(number)).resize(picture.size), float)
        assert np.abs(np.asarray(picture, float) - wanted).mean() < 12


@pytest.mark.parametrize("on_error", ["skip", "stop"])
def test_frames_that_cannot_be_read_keep_their_place(drive, folder, on_error):
    for number in (5, 25):
        (folder / f"{number:04}.jpg").write_bytes(b"no image")
    decisions = list(drive.decisions)
    decisions[10] = Decision(10, None, None, False, None, Reason.UNREADABLE)
    images = ImageSequence(folder, on_error=on_error)
    drive = replace(drive, decisions=tuple(decisions), query_images=images, reference_images=images)
    best = replace(decisions[25], score=0.99)
    page = Page(write_report(replace(drive, decisions=(*decisions[:25], best, *decisions[26:]))))
    assert "1 frame could not be read" in page.text
    assert "query 25 0025.jpg" in page.text
    assert "cannot be read" in page.text
    assert len(page.images("jpeg")) == 14


def test_hostile_names_stay_text(make_run, tmp_path):
    images = write_images(tmp_path / "x", 2)
    os.rename(images / "0001.jpg", images / HOSTILE)
    source = tmp_path / "<img src=x onerror=alert(2)>"
    os.rename(images, source)
    run = make_run(ImageSequence(source), [decide(0, None, None), decide(1, 0, 0.9, accepted=True)])
    assert HOSTILE in run.query_images.names
    for title in (None, "</title><script>alert(3)</script>"):
        page = Page(write_report(run, title=title))
        assert_self_contained(page)
        assert HOSTILE in page.text
        assert "<img src=x onerror=alert(2)>" in page.text
        assert (title or source.name) in page.text


@pytest.mark.skipif(sys.platform != "linux", reason="only here may a file name be no text")
def test_names_that_are_no_text(make_run, tmp_path):
    images = write_images(tmp_path / "x", 2)
    os.rename(os.fsencode(images / "0001.jpg"), os.fsencode(images) + b"/1\xff.jpg")
    run = make_run(ImageSequence(images), [decide(0, None, None), decide(1, 0, 0.9, accepted=True)])
    assert "1?.jpg" in Page(write_report(run)).text


@pytest.mark.parametrize(("weights", "warned"), [("random (seed 0)", True), ("efficientnet-lite0", False)])
def test_random_weights_are_marked(drive, weights, warned):
    run = replace(drive, info=drive.info | {"weights": {"weights": weights, "weights_sha256": "ab" * 32}})
    page = Page(write_report(run))
    assert ("Random weights." in page.text) is warned
    assert (("p", "role", "alert") in page.attributes) is warned


def test_a_method_without_weights(drive):
    assert "Random weights" not in Page(write_report(replace(drive, info=drive.info | {"weights": {}}))).text


def test_it_says_how_it_was_made(drive, drive_truth):
    config = dict(drive.info["config"])
    config["sequence"] = config["sequence"] | {"length": 7}
    run = replace(drive, info=drive.info | {"config": config})
    page = Page(write_report(run, **evaluated(run, drive_truth)))
    assert "sequence.length 7 (default 10)" in page.text
    assert "frames 0 to 29 of the drive" in page.text
    assert "0123456789ab" in page.text
    assert "0123456789abc" not in page.text
    assert drive_truth.sha256[:12] in page.text
    assert "Tolerance 0 frames" in page.text
    assert "numpy 2.0.0" in page.text
    assert "All settings are the default" in Page(write_report(drive)).text


def test_undefined_is_said(make_run, folder, make_truth):
    run = make_run(ImageSequence(folder), [decide(query, None, None) for query in range(40)])
    page = Page(write_report(run, **evaluated(run, make_truth([(35, 2)], (40, None)))))
    assert "undefined" in page.text
    assert "nan" not in page.text.lower().split()


def test_time_of_a_frame_counts_what_was_described(drive):
    against = replace(drive, info=drive.info | {"references": 60})
    saved = replace(against, reference_images=None)
    times = [facts.key_numbers(run, [], None)[2].value for run in (drive, against, saved)]
    seconds = [(2.0 + 0.2) / 40, 2.0 / 100 + 0.2 / 40, (2.0 + 0.2) / 40]
    assert times == [f"{1000 * each:.1f}" for each in seconds]


def test_every_reason_is_explained(drive):
    assert set(facts.REASONS) == set(Reason)
    counts = facts.reason_counts(drive.decisions)
    assert [(reason, count) for reason, _, count in counts] == [
        ("too_recent", 20),
        ("accepted", 19),
        ("below_threshold", 1),
    ]


def test_truth_of_another_run_is_refused(drive, make_truth):
    with pytest.raises(TruthError):
        write_report(drive, truth=make_truth([(3, 0)], (39, None)))


def test_a_long_drive_is_a_small_page(make_run, folder, tmp_path, make_truth):
    names = [folder / f"{number % 40:04}.jpg" for number in range(5000)]
    (tmp_path / "long.txt").write_text("\n".join(map(str, names)))
    rng = np.random.default_rng(0)
    decisions = [
        decide(query, int(rng.integers(0, query)) if query > 30 else None, rng.random(), accepted=query % 3 == 0)
        for query in range(5000)
    ]
    cells = rng.random((715, 715)).astype(np.float32)
    run = make_run(ImageSequence(tmp_path / "long.txt"), decisions, matrix=cells)
    truth = make_truth([(query, query - 2500) for query in range(2500, 5000)], (5000, None))
    file = write_report(run, **evaluated(run, truth), poses=rng.normal(size=(5000, 2)))
    assert file.stat().st_size < 3_000_000
    assert_self_contained(Page(file))

"""Printed boards: rasterised and detected, every corner stands where it should, in millimetres."""

import io
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.drawings import Line, Text, write_pdf, write_svg
from rgbd_calib.io.schema_parts import BoardModel
from rgbd_calib.patterns import charuco
from rgbd_calib.report import board_sheet, board_tiles
from rgbd_calib.types import APRILGRID_TAGS, Board, BoardShape
from rgbd_calib.views.detect import find_corners

PX_PER_MM = 4.0
BOARD = Board(8, 5, 0.03)
CHARUCO = Board(8, 5, 0.03, type="charuco", marker_m=0.022, dictionary="DICT_5X5_250")
APRILGRID = Board(12, 8, 0.0195, type="aprilgrid", marker_m=0.03, dictionary=APRILGRID_TAGS)


def pdf_pages(path):
    pypdfium2 = pytest.importorskip("pypdfium2")
    document = pypdfium2.PdfDocument(str(path))
    images = [page.render(scale=PX_PER_MM * 25.4 / 72).to_numpy()[..., 0] for page in document]
    sizes_mm = [np.array(page.get_size()) * 25.4 / 72 for page in document]
    document.close()
    return images, sizes_mm


def svg_page(path):
    resvg_py = pytest.importorskip("resvg_py")
    png = bytes(resvg_py.svg_to_bytes(svg_path=str(path), dpi=PX_PER_MM * 25.4, background="#ffffff"))
    return np.array(Image.open(io.BytesIO(png)).convert("L"))


def found_mm(image, board, page):
    """Corners (n, 2) on the page, mm, in reading order.

    The edge of the page is half a pixel before the first pixel's centre; the whole image is the whole page, whose size
    renderers round up to whole pixels.
    """
    if board.type == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        layout = cv2.aruco.CharucoBoard((board.cols + 1, board.rows + 1), board.square_m, board.marker_m, dictionary)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(image)
        assert np.array_equal(ids.ravel(), np.arange(board.n_corners))
        corners = corners.reshape(-1, 2)
    elif board.type == "aprilgrid":
        ids, corners = find_corners(image, board)
        assert np.array_equal(ids, np.arange(board.n_corners))
    else:
        ok, corners = cv2.findChessboardCornersSB(image, (board.cols, board.rows))
        assert ok
        corners = corners.reshape(-1, 2)
        corners = corners if corners[0, 1] < corners[-1, 1] else corners[::-1]  # it may begin at either end
    return (corners + 0.5) * np.array(page) / image.shape[::-1]


def expected_mm(board, page):
    return board_sheet.first_corner_mm(board, page) + board.corners_m()[:, :2] * 1000


# detectors find corners of a clean rendering to about 0.1 px; a page scaled by 1 % would be off by 1 mm and more
TOLERANCE_MM = 0.2 / PX_PER_MM


@pytest.mark.parametrize("board", [BOARD, CHARUCO, APRILGRID], ids=["checkerboard", "charuco", "aprilgrid"])
@pytest.mark.parametrize("suffix", [".pdf", ".svg"])
def test_detected_at_true_scale(tmp_path, board, suffix):
    page = board_sheet.page_mm(board, "auto")
    path = tmp_path / f"board{suffix}"
    sheets = board_sheet.sheets(board, page)
    if suffix == ".pdf":
        write_pdf(path, sheets, "a board")
        images, sizes_mm = pdf_pages(path)
        assert len(images) == 1 and np.allclose(sizes_mm[0], page, atol=0.01)
        image = images[0]
    else:
        write_svg(path, sheets[0], "a board")
        image = svg_page(path)
        assert image.shape == (round(page[1] * PX_PER_MM), round(page[0] * PX_PER_MM))
    assert np.abs(found_mm(image, board, page) - expected_mm(board, page)).max() < TOLERANCE_MM


@pytest.mark.parametrize(
    "board", [BOARD, replace(CHARUCO, cols=7), APRILGRID], ids=["checkerboard", "charuco", "aprilgrid"]
)
def test_corners_of_both_faces_coincide_through_the_board(tmp_path, board):
    board = replace(board, two_sided=True, thickness_m=0.006)
    page = board_sheet.page_mm(board, "A2")
    write_pdf(tmp_path / "board.pdf", board_sheet.sheets(board, page), "a board")
    images, _ = pdf_pages(tmp_path / "board.pdf")
    front_mm, back_mm = (found_mm(image, board, page) for image in images)
    behind_mm = np.stack([page[0] - back_mm[:, 0], back_mm[:, 1]], axis=1)  # turned about the vertical axis
    origin_mm = board_sheet.first_corner_mm(board, page)
    # types.Board says where the back's corners are in the front's frame
    assert np.abs(behind_mm - origin_mm - board.corners_m(back=True)[:, :2] * 1000).max() < TOLERANCE_MM
    c, r = np.arange(board.n_corners) % board.cols, np.arange(board.n_corners) // board.cols
    assert np.abs(front_mm - behind_mm[r * board.cols + board.cols - 1 - c]).max() < 2 * TOLERANCE_MM


def test_the_first_square_is_black_and_the_ruler_is_true(tmp_path):
    page = board_sheet.page_mm(BOARD, "A3")
    write_pdf(tmp_path / "board.pdf", board_sheet.sheets(BOARD, page), "a board")
    image = pdf_pages(tmp_path / "board.pdf")[0][0]
    x, y = np.array(board_sheet.first_corner_mm(BOARD, page)) * PX_PER_MM
    half = BOARD.square_m * 500 * PX_PER_MM
    assert image[int(y - half), int(x - half)] == image[int(y + half), int(x + half)] == 0
    assert image[int(y - half), int(x + half)] == 255
    # the long ticks: dark columns just above the numbers, 100 mm apart
    foot = int((page[1] - 30 + 2 + 3) * PX_PER_MM)
    columns = np.nonzero(image[foot] < 160)[0]
    ticks = columns[np.diff(columns, prepend=-9) > 2]
    assert np.allclose(np.diff(ticks), 100 * PX_PER_MM, atol=1)


def test_charuco_cells_are_those_of_opencv():
    for (corner_m, cells), number in zip(charuco.markers(CHARUCO), range(100), strict=False):
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        bits = cv2.aruco.Dictionary.getBitsFromByteList(dictionary.bytesList[number : number + 1], 5)
        assert np.array_equal(cells[1:-1, 1:-1], bits.astype(bool))
        assert not cells[0].any() and not cells[:, -1].any()
        # centred in a white square
        i, j = np.round((corner_m[:2] - 0.004) / 0.03).astype(int)
        assert np.allclose(corner_m[:2], np.array([i, j]) * 0.03 + 0.004, atol=1e-6) and (i + j) % 2 == 1


@pytest.mark.parametrize("board", [replace(BOARD, square_m=0.06), replace(APRILGRID, square_m=0.039, marker_m=0.06)])
def test_pages_joined_along_their_marks_are_the_board(tmp_path, board):
    sheets = board_tiles.tiles(board, "A4")
    assert 4 <= len(sheets) <= 9 and len({(sheet.width, sheet.height) for sheet in sheets}) == 1
    write_pdf(tmp_path / "board.pdf", sheets, "a board")
    pages, _ = pdf_pages(tmp_path / "board.pdf")
    rows: dict[int, list[np.ndarray]] = {}
    for page, sheet in zip(pages, sheets, strict=True):
        lines = [shape for shape in sheet.shapes if isinstance(shape, Line)][:8]  # the marks, before the ruler
        x0, x1 = sorted({line.x1 for line in lines if line.x1 == line.x2})
        y0, y1 = sorted({line.y1 for line in lines if line.y1 == line.y2})
        row = int(
            next(shape.text for shape in sheet.shapes if isinstance(shape, Text) and "row" in shape.text).split()[2]
        )
        part = page[round(y0 * PX_PER_MM) : round(y1 * PX_PER_MM), round(x0 * PX_PER_MM) : round(x1 * PX_PER_MM)]
        rows.setdefault(row, []).append(part)
    whole = np.concatenate([np.concatenate(row, axis=1) for row in rows.values()])
    ids, corners_px = find_corners(whole, board)
    assert np.array_equal(np.sort(ids), np.arange(board.n_corners))
    # each cut is rounded to a pixel: half a pixel from page to page
    apart = np.linalg.norm(corners_px - corners_px[0], axis=1) / PX_PER_MM
    true = np.linalg.norm(board.corners_m()[ids] - board.corners_m()[ids[0]], axis=1) * 1000
    assert np.abs(apart - true).max() < np.hypot(len(rows[1]), len(rows)) / PX_PER_MM
    two = board_tiles.tiles(replace(board, two_sided=True, thickness_m=0.005), "a4")
    assert len(two) == 2 * len(sheets)


def test_what_a_printer_shrank_is_drawn_larger(run, tmp_path):
    """The second print, shrunk as the first was, is true."""
    page = board_sheet.page_mm(BOARD, "auto")
    shrunk = np.array([0.996, 0.999])
    measured = (np.array([7, 4]) * 30 * shrunk).tolist()
    factors = board_tiles.scale_of(BOARD, "{:.3f}x{:.3f}".format(*measured))
    (sheet,) = (board_tiles.scaled(sheet, factors) for sheet in board_sheet.sheets(BOARD, page))
    write_pdf(tmp_path / "board.pdf", (sheet,), "a board")
    found = found_mm(pdf_pages(tmp_path / "board.pdf")[0][0], BOARD, page)
    middle = np.array(page) / 2
    assert np.abs(middle + (found - middle) * shrunk - expected_mm(BOARD, page)).max() < TOLERANCE_MM
    args = ("board", "--cols", "8", "--rows", "5", "--square", "0.03", "-o", tmp_path / "a.pdf")
    assert (
        "scaled by 1.0029 along the columns and 1.0042 along the rows"
        in run(*args, "--measured", "209.4x119.5", "--tile", "A4").stderr
    )
    for text in ("240x150", "209.4", "nanx120"):
        refused = run(*args, "--measured", text)
        assert refused.status == 2 and "near 210x120" in refused.stderr
    for more in (("--tile", "letter"), ("--tile", "A4", "--page", "A3")):
        assert run(*args, *more).status == 2


def test_pages():
    assert board_sheet.page_mm(Board(9, 6, 0.022), "auto") == (297.0, 210.0)
    assert board_sheet.page_mm(Board(9, 6, 0.060), "a0") == (841.0, 1189.0)
    assert board_sheet.page_mm(Board(9, 6, 0.060), "700x600") == (700.0, 600.0)
    with pytest.raises(ConfigError, match="--page 660x510"):
        board_sheet.page_mm(Board(9, 6, 0.060), "A4")
    with pytest.raises(ConfigError, match="auto, A4"):
        board_sheet.page_mm(BOARD, "letter")


@pytest.mark.parametrize("board", [BOARD, CHARUCO, APRILGRID, replace(BOARD, two_sided=True, thickness_m=0.0055)])
def test_printed_numbers_are_those_of_dataset_yaml(board):
    entry = yaml.safe_load(board_sheet.numbers(board))["board"]
    assert BoardModel.model_validate(entry).value() == board


def test_command_prints_the_numbers_and_is_repeatable_to_the_byte(run, tmp_path):
    args = ("board", "--cols", "8", "--rows", "5", "--square", "0.03", "--two-sided", "--thickness", "0.006")
    outcome = run(*args, "-o", tmp_path / "a.pdf")
    assert outcome.status == 0
    assert yaml.safe_load(outcome.stdout)["board"]["thickness"] == 0.006
    run(*args, "-o", tmp_path / "b.pdf")
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
    assert run(*args, "-o", tmp_path / "a.svg").status == 0
    assert (tmp_path / "a.back.svg").exists()
    again = run(*args, "-o", tmp_path / "a.pdf")
    assert again.status == 2 and "--overwrite" in again.stderr


def test_command_warns_of_a_board_that_half_a_turn_cannot_be_seen_of(run, tmp_path):
    outcome = run("board", "--cols", "10", "--rows", "6", "--square", "0.025", "-o", tmp_path / "a.pdf")
    assert outcome.status == 0 and "half a turn" in outcome.stderr


@pytest.mark.parametrize(
    ("args", "needle"),
    [
        (("--square", "60"), "Did you mean 0.06"),
        (("--square", "0.06", "--page", "A4"), "larger page"),
        (("--square", "0.03", "--type", "charuco", "--dictionary", "DICT_9X9"), "DICT_5X5_250"),
        (("--square", "0.03", "--type", "charuco", "--marker", "0.03"), "less than the square"),
        (("--square", "0.008", "--cols", "30", "--rows", "20", "--type", "charuco"), "325 are needed"),
    ],
)
def test_command_errors_leave_nothing(run, tmp_path, args, needle):
    outcome = run("board", *args, "-o", tmp_path / "a.pdf")
    assert outcome.status == 2 and needle in outcome.stderr
    assert run("board", "--square", "0.03", "-o", tmp_path / "a.png").status == 2
    assert list(tmp_path.iterdir()) == []


def test_a_measured_shape_is_where_the_corners_are(tmp_path):
    flat = Board(4, 3, 0.05, two_sided=True, thickness_m=0.006)
    rng = np.random.default_rng(0)
    front = flat.corners_m() + rng.normal(0, 1e-4, (12, 3))
    behind = flat.corners_m() * [1, 1, 0] + [0, 0, 0.006] + rng.normal(0, 1e-4, (12, 3))
    board = replace(flat, shape=BoardShape(front, behind))
    assert np.array_equal(board.corners_m(), front)
    # corner (c, r) of the front lies behind corner (cols - 1 - c, r) of the back
    assert np.array_equal(board.corners_m(back=True)[1 * 4 + 0], behind[1 * 4 + 3])
    assert np.abs(board.corners_m(back=True) - flat.corners_m(back=True)).max() < 1e-3
    again = BoardModel.model_validate(BoardModel.of(board).model_dump(exclude_none=True)).value()
    assert np.array_equal(again.shape.front_m, front) and np.array_equal(again.shape.back_m, behind)


def test_a_shape_of_another_board_is_refused():
    data = BoardModel.of(Board(4, 3, 0.05)).model_dump(exclude_none=True)
    data["shape"] = {"front_m": Board(4, 4, 0.05).corners_m().tolist()}
    with pytest.raises(ValueError, match="16 corners, a 4x3 board has 12"):
        BoardModel.model_validate(data)

"""The explorer's page: controls and the requests that they send, reports and how they are shown, keys and layout."""

from __future__ import annotations

import base64
import io
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from ckc_pin.explorer import messages
from tests.browser.explorer import PARAMETERS, QUANTITIES, ROOT, five_bar, open_explorer, program
from tests.browser.pages import Visit, browser, look_at, tabs

__all__ = ["browser", "five_bar", "look_at", "program", "tabs"]

HOSTILE = '"><img src=x onerror="window.pwned=1"><script>window.pwned=1</script>'


def row(visit: Visit, container: str, name: str) -> Any:
    return visit.page.locator(f"#{container} [data-name='{name}']")


def open_sections(visit: Visit) -> None:
    visit.page.evaluate("() => document.querySelectorAll('details').forEach(one => { one.open = true; })")


def texts(visit: Visit, selector: str) -> list[str]:
    return [text.strip() for text in visit.page.locator(selector).all_text_contents()]


# --- controls ------------------------------------------------------------------------------------


def test_number_field_moves_a_coordinate(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    row(visit, "coordinates", "theta_1").locator(".number").fill("-1.25")
    visit.page.keyboard.press("Enter")
    assert five_bar.take(2) == [messages.Move(coordinate="theta_1", value=-1.25), messages.Release()]
    visit.page.select_option("#angle-unit", "deg")
    row(visit, "coordinates", "theta_1").locator(".number").fill("90")
    visit.page.keyboard.press("Enter")
    move, release = five_bar.take(2)
    assert (move.coordinate, release) == ("theta_1", messages.Release())
    assert move.value == pytest.approx(np.pi / 2, abs=1e-15)
    row(visit, "coordinates", "theta_1").locator(".number").fill("")
    visit.page.keyboard.press("Enter")
    five_bar.take(0)


def test_dependent_coordinate_can_be_moved(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    assert not row(visit, "dependent", "theta_2").is_visible()
    visit.page.click("#dependent-section summary")
    row(visit, "dependent", "theta_2").locator(".number").fill("0.5")
    visit.page.keyboard.press("Enter")
    assert five_bar.take(2) == [messages.Move(coordinate="theta_2", value=0.5), messages.Release()]


def test_slider_sends_moves_and_one_release_per_gesture(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    slider = row(visit, "coordinates", "theta_3").locator(".slider")
    box = slider.bounding_box()
    y = box["y"] + box["height"] / 2
    at = box["x"] + 8 + (five_bar.values["theta_3"] / (2 * np.pi) + 0.5) * (box["width"] - 16)
    visit.page.mouse.move(at, y)
    visit.page.mouse.down()
    for k in range(1, 11):
        visit.page.mouse.move(at + 5 * k, y)
    visit.until("document.querySelector('#coordinates [data-name=theta_3] .slider').value > -0.8")
    # Reports do not overwrite a slider that is held, except for the reason of the end.
    five_bar.values["theta_3"] = -3.0
    five_bar.move(ended="theta_3", end="theta_3 is at its upper limit")
    visit.until("document.querySelector('#coordinates [data-name=theta_3] .note').textContent")
    value = float(slider.input_value())
    assert value > -0.8
    visit.page.mouse.up()
    moves = five_bar.take_through(messages.Release())[:-1]
    assert 1 <= len(moves) <= 10
    assert {type(move) for move in moves} == {messages.Move}
    assert moves[-1] == messages.Move(coordinate="theta_3", value=value)
    five_bar.move()
    visit.until("document.querySelector('#coordinates [data-name=theta_3] .slider').value < -2.9")


def test_arrow_keys_move_the_slider_with_the_focus(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    slider = row(visit, "coordinates", "theta_1").locator(".slider")
    slider.focus()
    before = float(slider.input_value())
    visit.page.keyboard.press("ArrowRight")
    move, release = five_bar.take(2)
    assert release == messages.Release()
    assert move.value == pytest.approx(before + 2 * np.pi / 1000, abs=1e-9)


def test_motor_sliders_exist_during_a_run(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    open_sections(visit)
    assert visit.page.locator("#motors .row").count() == 0
    five_bar.report(messages.RunReport(state="running", mode="free", motors={"theta_1": 1.5, "theta_3": 0.0}))
    motor = row(visit, "motors", "theta_1").locator(".number")
    motor.wait_for()
    assert motor.input_value() == "1.5"
    motor.fill("-2")
    visit.page.keyboard.press("Enter")
    assert five_bar.take(1) == [messages.SetMotor(name="theta_1", value=-2.0)]
    five_bar.report(messages.RunReport(state="paused", mode="hold", motors={"theta_1": 0.25}))
    visit.until("document.querySelector('#motors .unit').textContent === 'rad'")
    assert motor.input_value() == "0.25"
    five_bar.report(messages.RunReport(state="stopped", mode="hold"))
    visit.until("!document.querySelector('#motors .row')")
    assert "Motors have sliders during a run" in visit.page.inner_text("#motors-note")


def test_quantities_are_switched_and_show_their_lines(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    five_bar.move(quantities={"values": [["theta_1", "0.5 rad"], ["theta_3", "1 rad"]]})
    visit.until("document.querySelectorAll('#quantities [data-name=values] tr').length === 2")
    assert texts(visit, "#quantities [data-name=values] td") == ["theta_1", "0.5 rad", "theta_3", "1 rad"]
    boxes = {name: row(visit, "quantities", name).locator("input") for name in ("values", "forces", "reach")}
    assert [box.is_checked() for box in boxes.values()] == [True, False, False]
    assert boxes["reach"].is_disabled()
    assert row(visit, "quantities", "reach").locator(".reason").inner_text() == "no named points"
    boxes["forces"].check()
    boxes["values"].uncheck()
    assert five_bar.take(2) == [
        messages.Show(quantity="forces", on=True),
        messages.Show(quantity="values", on=False),
    ]
    five_bar.move()
    visit.until("!document.querySelector('#quantities tr')")


def test_margins_have_a_bar_a_number_and_words(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    five_bar.move(
        margins={"well": [0.4, 0.8], "near": [0.08, 0.8], "lost": [1e-9, 0.8], "at home singular": [1.0, 0.0]}
    )
    visit.until("document.querySelectorAll('.margin').length === 4")
    assert texts(visit, ".margin .value") == [
        "0.400, well conditioned",
        "0.0800, close to singular",
        "1.00e-9, singular",
        "1.00, singular",
    ]
    widths = [
        one.bounding_box()["width"] / visit.page.locator(".gauge").nth(0).bounding_box()["width"]
        for one in visit.page.locator(".margin .fill").all()
    ]
    np.testing.assert_allclose(widths, [0.5, 0.1, 0.0, 0.0], atol=0.01)
    assert visit.page.get_by_role("meter", name="near").get_attribute("aria-valuetext") == "0.0800, close to singular"


def test_branches_are_listed_and_selected(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    visit.page.click("#branches-section summary")
    visit.page.click("#branches-button")
    assert five_bar.take(1) == [messages.ListBranches(on=True)]
    five_bar.report(messages.BranchList(branches=["elbows out", "elbows in"], current=0, note="2 assemblies"))
    visit.until("document.querySelectorAll('#branches button').length === 2")
    assert texts(visit, "#branches button") == ["elbows out (present)", "elbows in"]
    visit.page.click("#branches button:nth-child(2)")
    visit.page.click("#branches-button")
    assert five_bar.take(2) == [messages.SelectBranch(index=1), messages.ListBranches(on=False)]


def paint_map(width: int, height: int) -> str:
    """Return a PNG whose red rises to the right and whose green rises upwards."""
    image = np.zeros((height, width, 3))
    image[:, :, 0] = np.linspace(0, 1, width)
    image[:, :, 1] = np.linspace(1, 0, height)[:, None]
    stream = io.BytesIO()
    matplotlib.image.imsave(stream, image)
    return base64.b64encode(stream.getvalue()).decode()


def test_click_in_the_map_goes_there(look_at, five_bar):
    visit = open_explorer(look_at, five_bar, size=(960, 900))
    visit.page.click("#map-section summary")
    visit.page.click("#map-button")
    assert five_bar.take(1) == [messages.ShowMap(on=True)]
    five_bar.values |= {"theta_1": -1.0 + 2 * np.pi, "theta_3": 1.0}  # a whole turn is the same place
    five_bar.move()
    five_bar.report(messages.MapImage(x="theta_1", y="theta_3", x_range=[-2.0, 2.0], y_range=[-1.0, 3.0], x_turns=True,
                                      image=paint_map(64, 64), note="green is up"))  # fmt: skip
    visit.until("document.getElementById('map').style.height")
    canvas = visit.page.locator("#map")
    canvas.scroll_into_view_if_needed()
    size = canvas.bounding_box()
    image = matplotlib.image.imread(io.BytesIO(canvas.screenshot()))[:, :, :3]
    assert visit.page.get_by_role("img", name="theta_1 and theta_3: green is up").count() == 1
    ys, xs = np.nonzero((image[:, :, 2] < 0.05) & (image[:, :, :2].sum(axis=2) > 0.2))  # the map has no blue
    left, right, top, bottom = xs.min(), xs.max() + 1, ys.min(), ys.max() + 1
    assert right - left == pytest.approx(bottom - top, abs=20)
    x, y = left + 0.75 * (right - left), top + 0.25 * (bottom - top)
    red, green, _ = image[int(y), int(x)]
    np.testing.assert_allclose([red, green], [0.75, 0.75], atol=0.03)
    # The cross is black with a white edge at a quarter and a half.
    centre = int(left + 0.25 * (right - left)), int(top + 0.5 * (bottom - top))
    assert image[centre[1], centre[0]].max() < 0.3
    canvas.click(position={"x": float(x), "y": float(y)})
    (go,) = five_bar.take(1)
    assert go.values == {"theta_1": pytest.approx(1.0, abs=0.05), "theta_3": pytest.approx(2.0, abs=0.05)}
    canvas.click(position={"x": 5.0, "y": float(size["height"]) - 5})  # outside of the picture
    visit.page.click("#map-button")
    assert five_bar.take(1) == [messages.ShowMap(on=False)]


def test_map_of_one_coordinate_goes_there(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    five_bar.report(messages.MapImage(x="theta_1", x_range=[-2.0, 2.0], image=paint_map(64, 1)))
    open_sections(visit)
    visit.until("document.getElementById('map').style.height")
    canvas = visit.page.locator("#map")
    canvas.click(position={"x": canvas.bounding_box()["width"] / 2, "y": 30.0})
    (go,) = five_bar.take(1)
    assert go.values == {"theta_1": pytest.approx(0.0, abs=0.02)}


def test_parameters_are_searched_changed_and_reset(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    visit.page.click("#change-section > summary")
    assert texts(visit, ".group > summary") == ["link.crank (2)", "link.rod (2)"]
    visit.page.fill("#parameter-search", "ROD.m")
    assert texts(visit, ".group:visible > summary") == ["link.rod (2)"]
    assert texts(visit, "#parameters .row:visible .name") == ["link.rod.mass"]
    mass = row(visit, "parameters", "link.rod.mass")
    mass.locator(".number").fill("1.5")
    visit.page.keyboard.press("Enter")
    assert five_bar.take(1) == [messages.SetParameter(name="link.rod.mass", value=1.5)]
    visit.page.fill("#parameter-search", "angle")
    assert texts(visit, "#parameters .row:visible .note") == ["changed; in the files: 1 rad"] * 2
    visit.page.select_option("#angle-unit", "deg")
    assert row(visit, "parameters", "link.rod.angle").locator(".number").input_value() == "85.9437"
    slider = row(visit, "parameters", "link.crank.angle").locator(".slider")
    slider.fill("0.5")
    assert five_bar.take(1) == [messages.SetParameter(name="link.crank.angle", value=0.5)]
    five_bar.report(five_bar.describe(quantities=QUANTITIES, parameters=PARAMETERS))  # the program refuses it
    visit.until("document.querySelector('#parameters [data-name=\"link.crank.angle\"] .slider').value === '1.5'")
    visit.page.click("#reset-parameters")
    assert five_bar.take(1) == [messages.ResetParameters()]
    five_bar.report(five_bar.describe(quantities=QUANTITIES, parameters=PARAMETERS[:2]))
    visit.until("document.querySelectorAll('.group').length === 1")


def test_run_is_started_paused_rewound_and_stopped(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    visit.page.click("#run-section summary")
    assert visit.page.locator("#mode option").all_text_contents() == ["torque sliders", "hold targets"]
    assert [visit.page.locator(f"#{name}").is_disabled() for name in ("pause", "stop", "time-slider")] == [True] * 3
    visit.page.select_option("#mode", "hold")
    visit.page.select_option("#formulation", "dae")
    visit.page.select_option("#speed", "0.5")
    visit.page.select_option("#rtol", "1e-8")
    visit.page.click("#start")
    start = messages.StartRun(mode="hold", speed=0.5, rtol=1e-8, formulation="dae")
    assert five_bar.take(1) == [start]
    five_bar.report(messages.RunReport(state="running", t=1.25, t_last=4.0, real_time=0.5, mode="hold"))
    visit.until("!document.getElementById('pause').disabled")
    assert visit.page.inner_text("#time") == "t = 1.25 of 4.00 s, 0.50 s per second"
    visit.page.click("#pause")
    visit.page.locator("#time-slider").fill("2.5")
    visit.until("true")
    assert five_bar.take(2) == [messages.Pause(on=True), messages.Rewind(t=2.5)]
    five_bar.report(messages.RunReport(state="paused", t=2.5, t_last=4.0, message="paused", mode="hold"))
    visit.until("document.getElementById('pause').textContent === 'continue'")
    assert visit.page.inner_text("#run-message") == "paused"
    visit.page.click("#pause")
    visit.page.click("#stop")
    assert five_bar.take(2) == [messages.Pause(on=False), messages.StopRun()]


def test_default_run_uses_the_formulation_of_the_scene(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    visit.page.click("#run-section summary")
    visit.page.click("#start")
    assert five_bar.take(1) == [messages.StartRun()]


def test_texts_are_copied_and_pictures_saved(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    visit.page.context.grant_permissions(["clipboard-read", "clipboard-write"], origin=five_bar.server.url)
    visit.page.click("#keep-section summary")
    five_bar.report(messages.TextReport(title="of another page", text="not ours", serial=1))
    visit.page.click("#copy-q_guess")
    assert five_bar.take(1) == [messages.CopyText(what="q_guess")]
    assert not visit.page.locator("#text-box").is_visible()
    five_bar.report(messages.TextReport(title="q_guess", text="[q_guess]\ntheta_1 = 1", serial=2))
    visit.until("document.getElementById('text-title').textContent.endsWith('copied')")
    assert visit.page.input_value("#text") == "[q_guess]\ntheta_1 = 1"
    assert visit.page.evaluate("() => navigator.clipboard.readText()") == "[q_guess]\ntheta_1 = 1"
    visit.page.click("#copy-python")
    assert five_bar.take(1) == [messages.CopyText(what="python")]
    with visit.page.expect_download() as drawing:
        visit.page.click("#picture-svg")
        assert five_bar.take(1) == [messages.CopyText(what="svg")]
        five_bar.report(messages.TextReport(title="picture", text="<svg/>", file_name="five_bar.svg", serial=3))
    assert drawing.value.suggested_filename == "five_bar.svg"
    assert drawing.value.path().read_text() == "<svg/>"
    with visit.page.expect_download() as photo:
        visit.page.click("#picture-png")
    assert photo.value.suggested_filename == "five_bar.png"
    image = matplotlib.image.imread(photo.value.path())
    pane = visit.page.locator("#meshcat-pane").bounding_box()
    assert image.shape[:2] == (pane["height"], pane["width"])
    assert ((image[:, :, 2] > 0.5) & (image[:, :, 0] < 0.3)).sum() > 100  # the blue link


def test_files_are_saved_under_valid_names(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    visit.page.click("#keep-section summary")
    visit.page.click("#save-scene")
    visit.page.fill("#file-name", "my_run-2")
    visit.page.click("#save-run")
    visit.page.click("#save-parameters")
    assert five_bar.take(3) == [
        messages.Save(what="scene", name="explored"),
        messages.Save(what="run", name="my_run-2"),
        messages.Save(what="parameters", name="my_run-2"),
    ]
    for wrong in ("../outside", "", "-x", "a b"):
        visit.page.fill("#file-name", wrong)
        visit.page.click("#save-scene")
    five_bar.take(0)
    five_bar.report(five_bar.describe(can_save=False))
    visit.until("document.getElementById('save-scene').disabled")
    assert "start the explorer with a folder" in visit.page.inner_text("#save-note")


def test_undo_redo_and_home(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    assert visit.page.locator("#undo").is_disabled()
    five_bar.move(can_undo=True, can_redo=True)
    visit.page.click("#undo")
    visit.page.click("#redo")
    visit.page.click("#home")
    assert five_bar.take(3) == [messages.Undo(), messages.Redo(), messages.Home()]


def test_keys_send_the_requests_of_the_buttons(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    press = visit.page.keyboard.press
    for key in ("Control+z", "Control+Shift+z", "Control+y", "h", "b", "m", "2", " "):
        press(key)
    assert five_bar.take(8) == [
        messages.Undo(),
        messages.Redo(),
        messages.Redo(),
        messages.Home(),
        messages.ListBranches(),
        messages.ShowMap(),
        messages.Show(quantity="forces", on=True),
        messages.StartRun(),
    ]
    five_bar.report(messages.RunReport(state="running", t_last=1.0, mode="free"))
    visit.until("!document.getElementById('pause').disabled")
    press(" ")
    assert five_bar.take(1) == [messages.Pause(on=True)]
    press("?")
    assert visit.page.get_by_role("dialog", name="Keys, mouse and touch").is_visible()
    press("h")
    press("Escape")
    assert not visit.page.locator("#help").is_visible()
    visit.page.click("#change-section > summary")
    visit.page.focus("#parameter-search")
    for key in ("h", "b", " ", "1"):
        press(key)
    five_bar.take(0)
    assert visit.page.input_value("#parameter-search") == "hb 1"
    visit.page.focus("#undo")
    visit.page.focus("#home")
    press(" ")
    assert five_bar.take(1) == [messages.Home()]  # the button's own key, not a run


def test_every_control_can_be_reached_by_tab_and_has_a_name(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    five_bar.report(messages.RunReport(state="running", t_last=1.0, mode="free"))
    five_bar.move(can_undo=True, can_redo=True)
    visit.until("document.querySelector('#motors .row')")
    open_sections(visit)
    controls = "#panel :is(button, input, select):not(:disabled)"
    expected = visit.page.locator(f"{controls}:visible").count()
    visited = set()
    for _ in range(3 * expected):
        visit.page.keyboard.press("Tab")
        visited.add(
            visit.page.evaluate(
                f"() => Array.from(document.querySelectorAll('{controls}')).indexOf(document.activeElement)"
            )
        )
    assert len(visited - {-1}) == expected
    for control in visit.page.locator(f"{controls}:visible").all():
        snapshot = control.aria_snapshot()
        assert '"' in snapshot, snapshot  # role and name


# --- reports -------------------------------------------------------------------------------------


def test_setup_and_pose_are_shown(look_at, five_bar):
    five_bar.report(five_bar.describe(title="a linkage", warnings=["not closed", "a loop is redundant"]))
    five_bar.move(closure=3.2e-13, ended="theta_3", end="theta_3 is at its limit")
    visit = open_explorer(look_at, five_bar)
    visit.until("document.getElementById('closure').textContent")
    assert visit.page.title() == "a linkage"
    assert visit.page.inner_text("#summary") == "4 coordinates, 2 freedoms"
    assert texts(visit, "#warnings li") == ["not closed", "a loop is redundant"]
    assert texts(visit, "#coordinates .name") == ["theta_1", "theta_3"]
    assert texts(visit, "#dependent .name") == ["theta_2", "theta_4"]
    assert visit.page.inner_text("#closure") == "Loops are closed to 3.2e-13 (m, rad)."
    assert row(visit, "coordinates", "theta_1").locator(".note").inner_text() == ""
    assert row(visit, "coordinates", "theta_3").locator(".note").inner_text() == "theta_3 is at its limit"
    value = float(row(visit, "coordinates", "theta_1").locator(".number").input_value())
    assert value == pytest.approx(five_bar.values["theta_1"], abs=1e-5)
    assert not visit.page.locator("#change-section").is_visible()


def test_rigid_mechanism_has_no_controls_that_do_nothing(look_at, program):
    rigid = program(modes=[], can_map=False, can_branch=False, coordinates=[])
    visit = look_at(rigid.server.url, "document.getElementById('summary').textContent")
    hidden = ("run", "map", "branches", "change", "dependent", "show")
    assert [visit.page.locator(f"#{name}-section").is_visible() for name in hidden] == [False] * 6
    visit.page.keyboard.press(" ")
    rigid.take(0)


def test_notices_are_shown_until_they_are_closed(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    five_bar.report(messages.Notice(text="cannot be assembled", is_error=True, serial=1))
    visit.until("!document.getElementById('notice').hidden")
    assert visit.page.inner_text("#notice-text") == "cannot be assembled"
    visit.page.click("#notice-close")
    assert not visit.page.locator("#notice").is_visible()


def test_html_in_names_and_texts_is_harmless(look_at, program):
    info = {"unit": "rad", "lower": -1.0, "upper": 1.0}
    hostile = program(
        title=HOSTILE,
        summary=HOSTILE,
        warnings=[HOSTILE],
        coordinates=[messages.CoordinateInfo(name=HOSTILE, has_stops=True, is_independent=True, **info)],
        motors=[messages.MotorInfo(name=HOSTILE, unit=HOSTILE, limit=1.0)],
        parameters=[messages.ParameterInfo(name=HOSTILE, group=HOSTILE, value=0.5, default=0.0, **info)],
        quantities=[messages.QuantityInfo(name=HOSTILE, label=HOSTILE, on=True, unavailable=HOSTILE)],
        modes=["free", HOSTILE],
        formulation=HOSTILE,
        bodies={HOSTILE: f"{ROOT}/{HOSTILE}"},
    )
    hostile.values = {HOSTILE: 0.5}
    hostile.move(end=HOSTILE, ended=HOSTILE, margins={HOSTILE: [0.1, 1.0]}, quantities={HOSTILE: [[HOSTILE, HOSTILE]]})
    visit = open_explorer(look_at, hostile)
    open_sections(visit)
    hostile.report(messages.BranchList(branches=[HOSTILE], current=0, note=HOSTILE))
    hostile.report(messages.MapImage(x=HOSTILE, x_range=[-1.0, 1.0], image=paint_map(8, 1), note=HOSTILE))
    hostile.report(messages.RunReport(state="running", t_last=1.0, message=HOSTILE, mode="free"))
    hostile.report(messages.Notice(text=HOSTILE))
    visit.page.click("#copy-python")
    hostile.take(1)
    hostile.report(messages.TextReport(title=HOSTILE, text=HOSTILE))
    visit.until("document.getElementById('text').value && document.querySelector('#motors .row')")
    row_number = visit.page.locator("#coordinates .number")
    row_number.fill("0.25")
    visit.page.keyboard.press("Enter")
    assert hostile.take(2)[0] == messages.Move(coordinate=HOSTILE, value=0.25)
    assert visit.page.locator("#title").inner_text() == HOSTILE
    assert visit.page.evaluate("() => [window.pwned, document.images.length, document.scripts.length]") == [None, 0, 2]
    shown = ["summary", "warnings", "end", "branches", "branches-note", "map-note", "run-message", "notice-text"]
    for name in shown:
        assert HOSTILE in visit.page.text_content(f"#{name}"), name


def test_many_frames_and_reports_do_not_grow_the_page(look_at, five_bar):
    visit = open_explorer(look_at, five_bar)
    count = "() => [document.querySelectorAll('*').length, viewer.scene.children.length, viewer.renderer.info.memory]"

    def send(k: int) -> None:
        five_bar.values["theta_1"] = 0.001 * k
        five_bar.report(five_bar.describe(quantities=QUANTITIES, parameters=PARAMETERS, warnings=[f"{k}"]))
        five_bar.report(messages.BranchList(branches=[f"{k}", "b"], current=0))
        five_bar.report(messages.RunReport(state="running", t=float(k), t_last=float(k), mode="free"))
        five_bar.move(margins={"m": [k, 1]}, quantities={"values": [[f"{k}", f"{k}"]]}, end=f"{k}")

    send(1)
    visit.until("document.getElementById('end').textContent === '1'")
    before = visit.page.evaluate(count)
    for k in range(2, 301):
        send(k)
    visit.until("document.getElementById('end').textContent === '300'")
    assert visit.page.evaluate(count) == before
    five_bar.requests.clear()


# --- layout --------------------------------------------------------------------------------------


def test_narrow_page_has_no_overflow_and_every_control_is_reachable(look_at, five_bar):
    visit = open_explorer(look_at, five_bar, size=(400, 800))
    name = "a_very_long_name_of_a_coordinate_without_any_place_to_break_a_line" * 2
    info = {"unit": "rad", "lower": -1.0, "upper": 1.0}
    five_bar.report(
        five_bar.describe(
            warnings=[name],
            quantities=[*QUANTITIES, messages.QuantityInfo(name="long", label=name, on=True)],
            parameters=[messages.ParameterInfo(name=name, group=name, value=0.5, default=0.0, **info)],
            coordinates=[messages.CoordinateInfo(name=name, has_stops=True, is_independent=True, **info)],
        )
    )
    five_bar.move(
        values={name: 0.5}, end=name, ended=name, margins={name: [0.1, 1.0]}, quantities={"long": [[name] * 2]}
    )
    five_bar.report(messages.BranchList(branches=[name], current=0, note=name))
    five_bar.report(messages.RunReport(state="running", t_last=1.0, message=name, mode="free"))
    visit.until("document.querySelectorAll('#coordinates .row').length === 1 && document.querySelector('.margin')")
    open_sections(visit)
    for selector in ("html", "#view", "#panel", "#sections"):
        widths = visit.page.evaluate(
            f"() => (one => [one.scrollWidth, one.clientWidth])(document.querySelector('{selector}'))"
        )
        assert widths[0] <= widths[1] <= 400, selector
    for control in visit.page.locator("#panel :is(button, input, select):visible").all():
        control.scroll_into_view_if_needed()
        box = control.bounding_box()
        assert box["x"] >= 0, control
        assert box["x"] + box["width"] <= 400, control
        assert -1 < box["y"] < 801 - box["height"], control  # scrolling rounds to pixels
    assert visit.page.locator("#meshcat-pane").bounding_box()["height"] > 300
    visit.page.click("#collapse")
    assert visit.page.locator("#collapse").get_attribute("aria-expanded") == "false"
    assert visit.page.locator("#meshcat-pane").bounding_box()["height"] > 700
    visit.until("document.querySelector('canvas').clientHeight > 700")
    visit.page.click("#collapse")
    assert visit.page.locator("#move-section").is_visible()


def test_wide_page_keeps_most_of_its_width_for_the_picture(look_at, five_bar):
    visit = open_explorer(look_at, five_bar, size=(1280, 800))
    box = visit.page.locator("#meshcat-pane").bounding_box()
    assert (box["width"], box["height"]) == (pytest.approx(940, abs=2), 800)
    assert not visit.page.locator(".dg").first.is_visible()
    assert not visit.page.locator("#collapse").is_visible()

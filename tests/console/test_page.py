"""The page in a real browser, before a real console that joins a real hub with a real centre and two sensors."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import schemas
from fusion_service.bus import Publisher
from schemas import GlobalTracks, Status, StepLog
from sensor_clients.publisher import TrackPublisher
from tests.console.scenes import FIRST, picture, status, step_log
from tests.helpers.browser import CHROMIUM, Browser, Page
from tests.helpers.processes import Hub, Program, eventually, free_endpoint
from tests.helpers.scene import COMMAND, Scene, opened

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed: apt-get install chromium")
HOSTILE = '<img src=x onerror="document.title=1">'
STEERS = "\u202eevil\x1b[31m"
PICK = """(() => {
  const one = document.querySelector('%s');
  one.value = '%s';
  one.dispatchEvent(new Event('change'));
})()"""
WIDE = """(() => {
  const shown = [...document.querySelectorAll('main *')].filter((one) => one.checkVisibility() && !one.closest('#map'));
  const right = shown.map((one) => one.getBoundingClientRect().right);
  return Math.max(document.documentElement.scrollWidth, ...right);
})()"""
IS_FULL = """(() => {
  const [x, y] = fusionConsole.sensor('buoy');
  const map = document.querySelector('#map').getBoundingClientRect();
  const canvas = document.querySelector('canvas.drawn:not([hidden])');
  const box = canvas.getBoundingClientRect();
  const [left, top] = [map.x + x - box.x, map.y + y - box.y].map(Math.round);
  return canvas.getContext('2d').getImageData(left - 2, top + 1, 1, 1).data[3] > 200;
})()"""
IS_DRAWN = """(() => {
  const [x, y] = fusionConsole.at(%s);
  const map = document.querySelector('#map').getBoundingClientRect();
  for (const canvas of document.querySelectorAll('canvas.drawn:not([hidden])')) {
    const box = canvas.getBoundingClientRect();
    const [left, top] = [map.x + x - box.x, map.y + y - box.y].map(Math.round);
    if (canvas.getContext('2d').getImageData(left, top, 1, 1).data[3] > 200) return true;
  }
  return false;
})()"""


class Room:
    """What all tests of this file look at."""

    def __init__(self, scene: Scene, hub: Hub, browser: Browser) -> None:
        self.scene, self.hub, self.browser = scene, hub, browser
        self._port = free_endpoint().rpartition(":")[2]
        self.program = self.console()
        self.address = ""

    def console(self) -> Program:
        """Start the console, at the same port every time."""
        where = ("--connect", self.scene.endpoint, "--listen", f"127.0.0.1:{self._port}")
        return self.scene.start(COMMAND, "console", *where, "--allow-orders")

    def heard(self) -> None:
        """Wait for the address that it prints."""
        said = self.program.line(30)
        assert said.startswith(f"console: http://127.0.0.1:{self._port}/#token=")
        self.address = said.removeprefix("console: ")

    def ids(self) -> list[str]:
        """Of the confirmed tracks of the two targets."""
        return [str(one) for _, one in sorted(self.scene.seen.confirmed().items())]

    def open(self, address: str | None = None, width: int = 1280, height: int = 800) -> Page:
        page = self.browser.page(address or self.address, width, height)
        page.until("document.querySelector('#map').dataset.tracks >= 2 && document.body.dataset.link === 'live'")
        return page


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    with ExitStack() as stack:
        hub = Hub().start()
        stack.callback(hub.kill)
        scene = stack.enter_context(opened(hub, tmp_path_factory.mktemp("console")))
        scene.service()
        browser = Browser()
        made = Room(scene, hub, browser)
        scene.sensor("r1", 0, 1)
        scene.sensor("r2", 0, 1)
        stack.enter_context(browser)
        made.heard()
        eventually(scene.seen.sees(0, 1), 30)
        yield made


@pytest.fixture(scope="module")
def page(room: Room) -> Page:
    return room.open()


def choose(page: Page, track: str) -> None:
    place = f"fusionConsole.at({json.dumps(track)})"

    def resting() -> list[float] | None:
        """Where it is, once the map has come to rest."""
        at: list[float] = page.until(place)
        time.sleep(0.1)
        return at if page.until(place) == at else None

    x, y = page.wait(resting)
    box = page.js(
        "(() => { const box = document.querySelector('#map').getBoundingClientRect(); return [box.x, box.y]; })()"
    )
    page.click_at(box[0] + x, box[1] + y)
    page.until(f"document.querySelector('#track .facts').innerText.includes({json.dumps(track)})")


def test_tracks_are_drawn_and_a_click_explains_one(room: Room, page: Page) -> None:
    for track in room.ids():
        page.until(IS_DRAWN % json.dumps(track))
    choose(page, room.ids()[1])
    told = page.text("#track")
    assert "Confirmed, from 2 sources, fused by" in told
    assert "Ellipse, 2 σ" in told
    rows = page.text("#track tbody").splitlines()
    assert {row.split("\t")[0].split()[0] for row in rows if row.strip()} >= {"r1", "r2"}
    page.click("#tab-sources")
    page.until("document.querySelector('#sources').innerText.includes('2 of 2 sources are there')")
    assert "one every 0.2 s declared" in page.until("document.querySelector('#sources').innerText")
    page.click("#tab-log")
    page.until("document.querySelector('#log').innerText.length > 10")
    assert page.text("#sigma-said") == "ellipses: 2 σ"
    assert list(page.complaints) == []


def test_keys_search_and_go_from_track_to_track(room: Room, page: Page) -> None:
    page.key("Escape")
    page.key("/")
    assert page.js("document.activeElement.id") == "search"
    page.type(room.ids()[1])
    page.until("document.querySelector('#tracks .count').innerText.startsWith('1 of ')")
    page.key("Enter")
    page.until(f"document.querySelector('#track .facts').innerText.includes({json.dumps(room.ids()[1])})")
    page.js("document.querySelector('#search').focus()")
    page.key("Escape")
    first = page.text("#track h2")
    page.key("n")
    page.until(f"document.querySelector('#track h2').innerText !== {json.dumps(first)}")
    page.key("p")
    page.until(f"document.querySelector('#track h2').innerText === {json.dumps(first)}")
    page.key("4")
    assert page.js("document.querySelector('#tab-alarms').getAttribute('aria-selected')") == "true"
    page.key("?")
    assert page.js("document.querySelector('#help-dialog').open") is True
    page.key("Escape")
    page.until("!document.querySelector('#help-dialog').open")
    page.key("Escape")
    page.until("!document.querySelector('#tracks').hidden")
    assert list(page.complaints) == []


def test_without_the_token_nothing_can_be_ordered(room: Room) -> None:
    page = room.open(room.address.partition("#")[0])
    choose(page, room.ids()[0])
    assert page.js("document.querySelector('#track button.order').hidden") is True
    page.click("#tab-orders")
    assert "Orders need the token" in page.text("#orders")
    page.key("o")
    assert page.js("document.querySelector('#order-dialog').open") is False
    assert page.js("fetch('/order', {method: 'POST', body: '{}'}).then((one) => one.status)") == 403


def test_an_order_is_confirmed_given_told_and_withdrawn(room: Room, page: Page) -> None:
    assert page.js("location.href").endswith("/"), "the token does not stay in the address"
    choose(page, room.ids()[0])
    page.click("#track button.order")
    page.until("document.querySelector('#order-dialog').open")
    assert "show a global track under a number or callsign" in page.text("#order-dialog .says")
    fields = "document.querySelectorAll('#order-dialog input')"
    for k, words in enumerate(("PILOT 2", "", "as arranged", "anna")):
        page.js(f"{fields}[{k}].select()")
        page.type(words)
    page.click("#order-dialog button[type=submit]")
    page.until("/^Order \\d+: /.test(document.querySelector('#order-dialog .answer').innerText)")
    page.click("#order-dialog .buttons button")
    page.until("document.querySelector('#track h2').innerText.startsWith('PILOT 2')")
    page.click("#tab-log")
    page.until(
        "/order rename .*PILOT 2 by anna \\(unproven\\) \\(as arr/.test(document.querySelector('#log').innerText)"
    )
    page.click("#tab-orders")
    page.until("document.querySelector('#orders').innerText.includes('by anna (unproven): as arranged')")
    page.click("#orders li button")
    page.js(f"{fields}[0].focus()")
    page.type("over")
    page.click("#order-dialog button[type=submit]")
    page.until("document.querySelector('#order-dialog .answer').className.endsWith('done')")
    page.click("#order-dialog .buttons button")
    page.until("document.querySelector('#orders').innerText.includes('No order stands')")
    assert list(page.complaints) == []


def test_an_order_that_is_refused_says_why(room: Room, page: Page) -> None:
    choose(page, room.ids()[0])
    page.click("#track button.order")
    page.js(PICK % ("#order-dialog select", "merge"))
    fields = "document.querySelectorAll('#order-dialog input')"
    for k, words in enumerate(("4711", "because", "anna")):  # who it is may stand there from before
        page.js(f"{fields}[{k}].select()")
        page.type(words)
    page.click("#order-dialog button[type=submit]")
    page.until("document.querySelector('#order-dialog .answer').className.endsWith('refused')")
    assert "there is no track 4711" in page.text("#order-dialog .answer")
    page.key("Escape")


def test_hostile_names_are_text(room: Room, page: Page) -> None:
    """Another centre of the realm says markup and signs that steer in all that it can say."""
    bus, texts = room.scene.bus, (HOSTILE, STEERS, None)
    said = {"alive": True, "note": HOSTILE, "alarms": [HOSTILE], "last_refusal": {"reason": HOSTILE, "said": HOSTILE}}
    events = ({"kind": HOSTILE, "source": HOSTILE}, {"kind": "order", "what": HOSTILE, "who": HOSTILE, "track": FIRST})
    messages: dict[str, GlobalTracks | StepLog | Status] = {
        "tracks": picture(3, name="evil", identity=texts, callsign=texts, kind=texts, rule=HOSTILE),
        "log": step_log([], source="evil", events=events),
        "status": status(sources={HOSTILE: said, "W" * 200: said}, name="evil"),
    }
    keys = [schemas.global_key("evil", what) for what in messages]
    publishers: list[Publisher] = [bus.publisher(key) for key in keys]
    try:
        for publisher, message in zip(publishers, messages.values(), strict=True):
            publisher.put(schemas.encode(message))
        page.until("document.querySelectorAll('#centre option').length === 2")
        page.js(PICK % ("#centre", "evil"))
        page.js("document.querySelector('#tab-tracks').click()")
        page.until("document.querySelectorAll('#tracks li').length === 3")
        assert HOSTILE in page.text("#tracks")
        assert "\\u202eevil\\u001b[31m" in page.text("#tracks")
        page.js("document.querySelector('#tracks li button').click()")
        page.until("document.querySelector('#track h2').innerText.includes('<img src=x')")
        for tab in ("sources", "alarms", "log"):
            page.js(f"document.querySelector('#tab-{tab}').click()")
            page.until(f"document.querySelector('#{tab}').innerText.includes('<img src=x')")
        page.size(390, 844)
        page.js("document.querySelector('#tab-sources').click()")
        tall = "[...document.querySelectorAll('#sources .state, #sources .head button')].map((one) => one.offsetHeight)"
        page.until(f"Math.max(...{tall}) < 45", 20)
        page.size(1280, 800)
        assert page.js("[document.querySelectorAll('img').length, document.title]") == [0, "Fusion console · fusion"]
        page.js(PICK % ("#centre", "centre"))
        page.until("document.querySelectorAll('#map').length && document.querySelector('#map').dataset.tracks === '2'")
        assert list(page.complaints) == []
    finally:
        for publisher in publishers:
            publisher.close()


def test_the_map_goes_on_over_the_date_line_and_shows_the_place_where_there_is_nothing(room: Room, page: Page) -> None:
    """Tracks on both sides of 180 degrees are near each other; without any, the origin of the frame is shown."""
    bus, fiji = room.scene.bus, schemas.Enu(-17.0, 179.999)
    tracks, token = (
        bus.publisher(schemas.global_key("fiji", "tracks")),
        bus.announce(schemas.global_key("fiji", "alive")),
    )
    health, stack = bus.publisher(schemas.global_key("fiji", "status")), ExitStack()
    seen = "document.querySelector('#map').dataset.tracks"
    try:
        tracks.put(schemas.encode(picture(3, name="fiji", frame=fiji)))
        page.until("[...document.querySelectorAll('#centre option')].some((one) => one.value === 'fiji')")
        page.js(PICK % ("#centre", "fiji"))
        page.until(f"{seen} === '3'")
        page.js("document.querySelector('#fit').click()")
        left, right = (page.until(f"fusionConsole.at('{FIRST + k}')")[0] for k in (0, 2))
        assert left < right < left + 2000, "100 m lie between two of them"
        assert page.text("#scale .say").endswith(" m")
        tracks.put(schemas.encode(picture(0, step=2, name="fiji", frame=fiji)))
        page.until(f"{seen} === '0'")
        page.js("document.querySelector('#fit').click()")
        page.until("/^\\d+ m$|^[1-9]\\d?\\.\\d km$/.test(document.querySelector('#scale .say').innerText)")
        buoy = stack.enter_context(TrackPublisher("buoy", connect=room.scene.endpoint, wait=20.0))
        buoy.info(frame=fiji, position=(2000.0, 1000.0, 5.0), period=1.0, motion=schemas.Motion("cv", q=1.0))
        for there in (True, False):  # a full sign, and a hollow one when it has gone
            said = status(sources={"buoy": {"alive": there, "messages": 1}}, name="fiji")
            health.put(schemas.encode(said))
            page.until(f"({IS_FULL}) === {json.dumps(there)}")
    finally:
        stack.close()
        health.close()
        tracks.close()
        token.close()
        page.js(PICK % ("#centre", "centre"))
    assert list(page.complaints) == []


def test_the_policy_lets_no_text_become_markup_or_script(page: Page) -> None:
    for attempt in ("document.body.innerHTML = '<b>x</b>'", "document.body.setAttribute('onclick', 'x')"):
        refused = f"(() => {{ try {{ {attempt}; return 'let in' }} catch (error) {{ return error.name }} }})()"
        assert page.js(refused) == "TypeError", attempt
    page.complaints.clear()


def test_both_themes(page: Page) -> None:
    """As the system, also when that changes, and as it was chosen, also when the page comes again."""
    ground = "getComputedStyle(document.body).backgroundColor"
    for scheme, colour in (("dark", "rgb(16, 22, 28)"), ("light", "rgb(244, 246, 248)")):
        page.scheme(scheme)
        page.until(f"{ground} === {json.dumps(colour)}")
    page.key("t")
    page.key("t")
    assert page.js("document.documentElement.dataset.theme") == "dark"
    page.call("Page.reload")
    page.until("document.documentElement.dataset.theme === 'dark' && document.body.dataset.link === 'live'")
    assert page.js(ground) == "rgb(16, 22, 28)"
    page.key("t")


def test_a_narrow_screen_scrolls_in_one_direction(room: Room, page: Page) -> None:
    page.size(390, 844)
    page.until(f"fusionConsole.at({json.dumps(room.ids()[0])})")
    page.js("document.querySelector('#fit').click()")
    choose(page, room.ids()[0])
    for tab in ("tracks", "sources", "alarms", "log", "orders", "track"):
        page.js(f"document.querySelector('#tab-{tab}').click()")
        assert page.js(WIDE) <= 390, tab
    page.click("#track button.order")
    page.until("document.querySelector('#order-dialog').open")
    assert page.js("document.querySelector('#order-dialog').getBoundingClientRect().width") <= 390
    page.key("Escape")
    page.size(1280, 800)


def test_hub_and_console_go_and_come(room: Room, page: Page) -> None:
    room.hub.kill()
    page.until("document.body.dataset.link === 'closed'", 30)
    page.until("/the hub is away/.test(document.querySelector('#banner').innerText)", 30)
    assert page.js("document.querySelector('#banner').hidden") is False
    assert page.text("#tab-alarms").startswith("Alarms ")
    assert "the hub is away" in page.js("document.querySelector('#alarms').textContent")
    room.hub.start()
    page.until("document.body.dataset.link === 'live'", 40)
    room.program.signal(signal.SIGTERM)
    code, told = room.program.end()
    assert code == 0, told
    page.until("/no connection to the console/.test(document.querySelector('#link').innerText)", 30)
    room.program = room.console()
    room.heard()
    page.until("document.body.dataset.link === 'live'", 40)
    page.until("document.querySelector('#orders').textContent.includes('Orders need the token')")
    page.js(f"location.hash = {json.dumps(room.address.partition('#')[2])}")
    page.until("!document.querySelector('#orders').textContent.includes('Orders need the token')", 30)


def test_what_cannot_be_served_is_one_line(room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from fusion_service.cli import main

    (tmp_path / "token").write_text("short")
    port = room.address.partition("/#")[0].rpartition(":")[2]
    for given in (
        ["--listen", f"127.0.0.1:{port}"],
        ["--token-file", str(tmp_path / "token")],
        ["--token-file", str(tmp_path / "none")],
        ["--tiles", "nonsense"],
        ["--certificate", str(tmp_path / "token")],
        ["--centre", "a/b"],
    ):
        assert main(["console", "--connect", room.scene.endpoint, *given]) == 2, given
        told = capsys.readouterr().err
        assert told.startswith("fusion-service console: ")
        assert told.count("\n") == 1

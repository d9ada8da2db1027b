# SPDX-License-Identifier: Apache-2.0
"""The page with a server of its own, without ROS, and a real browser that is driven by it.

The browser is headless Chromium by its DevTools protocol (chromedevtools.github.io).
"""

import asyncio
import base64
import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import aiohttp

from bench.live.opc_ua import free_port
from robocal_ros.ground.errors import Code
from robocal_ros.panel.server import PanelCall, PanelServer, PanelSettings, host_names
from robocal_ros.panel.sessions import encryption
from robocal_ros.panel.state import ACCURACY, LEVELS, MAINTENANCE, PENDING, STATUS

CHROMIUM = os.environ.get("ROBOCAL_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
WITHIN_S = 20.0
NOTHING = {
    "cycle_id": "", "code": 0, "message": "", "complete": False, "thermal_code": 0,
    "thermal_id": 0, "tool_found_code": 0, "tool_code": 0, "tool_id": 0, "station_code": 0,
    "left": [], "accepted": [], "stamp_ns": 0,
}  # fmt: skip


def accuracy(level: str = "OK", **changes: Any) -> dict[str, Any]:
    """What maintenance_node says of the accuracy."""
    figures = {"predicted_error_mm": 0.08, "bound_mm": 0.16, "tolerance_mm": 0.3}
    told = {"robot": "KR 150", "serial": "K7", "due_in_s": 1500.0, "reason": f"so it is {level}"}
    return {"state": LEVELS.index(level), **figures, **told, **changes}


def ended(cycle_id: str = "gap-1", code: Code = Code.ACCEPT, **changes: Any) -> dict[str, Any]:
    """How a gap ended."""
    told = {"cycle_id": cycle_id, "code": int(code), "message": "as planned", "complete": True}
    return (
        NOTHING | told | {"stamp_ns": time.time_ns(), "thermal_code": 1, "tool_code": 1} | changes
    )


def status(state: str = "IDLE", **changes: Any) -> dict[str, Any]:
    """What maintenance_node says of itself."""
    return {
        "state": MAINTENANCE.index(state), "cycle_id": "", "doing": "", "left_s": 0.0,
        "at_home": True, "fault_code": 0, "fault": "", "last": NOTHING,
    } | dict.fromkeys(PENDING, 0) | changes  # fmt: skip


class Cell:
    """A server, and the nodes that it hears: what is in ``says`` is said five times a second."""

    def __init__(
        self,
        folder: Path | None = None,
        state_dir: Path | None = None,
        port: int = 0,
        public_view: bool = True,
    ) -> None:
        self.port = port or free_port()
        self.says: dict[str, dict[str, Any]] = {ACCURACY: accuracy(), STATUS: status()}
        self.calls: list[PanelCall] = []
        self.told: list[str] = []
        self.answers: Callable[[PanelCall], dict[str, Any] | None] = lambda call: {
            "done": True,
            "message": f"{call.act} done",
        }
        settings = PanelSettings(
            "127.0.0.1", self.port, folder, public_view, state_dir, "",
            None if folder is None else encryption(folder), host_names(frozenset()),
        )  # fmt: skip
        self.server = PanelServer(settings, self._call, self.told.append)
        until_s = time.monotonic() + WITHIN_S
        while self.server.trouble:
            assert time.monotonic() < until_s, self.told
            time.sleep(0.02)
        self._ended = threading.Event()
        self._nodes = threading.Thread(target=self._say, daemon=True)
        self._nodes.start()
        self.url = f"http{'s' * (folder is not None)}://127.0.0.1:{self.port}"

    def _say(self) -> None:
        while not self._ended.wait(0.2):
            for name, values in list(self.says.items()):
                self.server.show(name, values, time.time_ns())

    def _call(self, call: PanelCall) -> None:
        self.calls.append(call)
        if (answer := self.answers(call)) is not None:
            call.answer.set_result(answer)

    def silence(self) -> None:
        """Its nodes say nothing any more."""
        self._ended.set()
        self._nodes.join()

    def close(self) -> None:
        self.silence()
        self.server.stop()


class Loop:
    """Runs what waits in a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def start(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self.start(work).result(WITHIN_S)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


class Browser(Loop):
    """Headless Chromium with one page; what its console complains of is in ``complaints``."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.complaints: list[str] = []
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._process = subprocess.Popen(
            [
                CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--mute-audio",
                "--no-first-run", "--disable-extensions", "--disable-background-networking",
                "--ignore-certificate-errors", "--remote-debugging-port=0",
                "--disable-dev-shm-usage", f"--user-data-dir={folder}", "about:blank",
            ],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        told, until_s = folder / "DevToolsActivePort", time.monotonic() + WITHIN_S
        while not (told.exists() and told.read_text().count("\n")):
            assert time.monotonic() < until_s, "Chromium does not start"
            assert self._process.poll() is None, "Chromium ended"
            time.sleep(0.05)
        self.do(self._open(int(told.read_text().split()[0])))

    async def _open(self, port: int) -> None:
        self._http = aiohttp.ClientSession()
        async with self._http.get(f"http://127.0.0.1:{port}/json/list") as answer:
            pages = [page for page in await answer.json() if page["type"] == "page"]
        self._socket = await self._http.ws_connect(
            pages[0]["webSocketDebuggerUrl"], max_msg_size=2**26
        )
        self._reader = asyncio.create_task(self._read())
        for domain in ("Page", "Runtime", "Log", "Network"):
            await self._command(f"{domain}.enable")

    async def _read(self) -> None:
        async for message in self._socket:
            told = json.loads(message.data)
            if "id" in told:
                self._waiting.pop(told["id"]).set_result(told)
            elif told["method"] == "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(told["params"]["exceptionDetails"])[:500])
            elif told["method"] == "Log.entryAdded":
                entry = told["params"]["entry"]
                if entry["level"] == "error" and entry["source"] != "network":
                    self.complaints.append(entry["text"])

    async def _command(self, method: str, **parameters: Any) -> Any:
        number = len(self._waiting) + time.monotonic_ns() % 2**30
        waits = self._waiting[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        answer = await waits
        assert "error" not in answer, answer
        return answer["result"]

    def command(self, method: str, **parameters: Any) -> Any:
        return self.do(self._command(method, **parameters))

    def size(self, width: int, height: int, *, phone: bool, dark: bool = False) -> None:
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if phone else 1, mobile=phone,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", features=[scheme])

    def go(self, url: str) -> None:
        self.command("Page.navigate", url=url)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def run(self, script: str) -> Any:
        """Value of an expression of the page."""
        found = self.command(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, (script, found["exceptionDetails"])
        return found["result"].get("value")

    def until(self, script: str, within_s: float = WITHIN_S) -> Any:
        until_s = time.monotonic() + within_s
        while not (found := self.run(script)):
            shown = self.run("document.body.innerText.slice(0, 1500)")
            assert time.monotonic() < until_s, (script, shown, self.complaints)
            time.sleep(0.05)
        return found

    def text(self, selector: str) -> str:
        return str(self.run(f"document.querySelector({selector!r})?.innerText ?? ''"))

    def click(self, words: str) -> None:
        """Touch the button that says so, by a real touch in its middle."""
        place = self.until(
            "(() => { const b = [...document.querySelectorAll('button, a, summary')].find(b => "
            f"b.innerText.trim() === {words!r} && b.getClientRects().length); "
            "if (!b) return null; b.scrollIntoView({block: 'center', behavior: 'instant'}); "
            "const r = b.getBoundingClientRect(); "
            "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        x, y = place
        for kind in ("mousePressed", "mouseReleased"):
            self.command(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
            )

    def type(self, selector: str, words: str) -> None:
        self.run(f"document.querySelector({selector!r}).focus()")
        self.command("Input.insertText", text=words)

    def picture(self, path: Path, *, whole: bool = False) -> None:
        shot = self.command("Page.captureScreenshot", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(shot["data"]))

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(WITHIN_S)

        async def leave() -> None:
            self._reader.cancel()
            await self._socket.close()
            await self._http.close()

        self.do(leave())
        super().close()

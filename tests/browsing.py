"""A real browser for tests of pages, and what they ask of one.

Needs Debian's packages chromium and chromium-driver; without them the tests are skipped, and fail where the
variable UAVNAV_BROWSER is `required`.
"""

import json
import os
import shutil
from pathlib import Path

import axe_core_python
import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

RESULTS = Path(__file__).parent.parent / "results"
CONFIGURATIONS = [
    f"{algorithm}/{activation}"
    for algorithm in ("ppo", "dqn")
    for activation in ("tanh", "sigmoid", "relu", "leaky_relu")
]
AXE = Path(axe_core_python.__file__).parent / "axe.min.js"
WIDE, NARROW = 1280, 390  # [px]
NAMES = ("chromium", "chromedriver")
PAIRS = """
const channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
const light = (part) => (part /= 255) <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4;
const luminance = ([r, g, b]) => 0.2126 * light(r) + 0.7152 * light(g) + 0.0722 * light(b);
const behind = (element) => {
  for (let one = element; one; one = one.parentElement) {
    const found = channels(getComputedStyle(one).backgroundColor);
    if (found.length === 3 || found[3] === 1) return found;
  }
  return [255, 255, 255];
};
const worst = {};
for (const element of document.querySelectorAll("body *")) {
  const own = [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
  if (!own || !element.getClientRects().length || element.closest("script, noscript, option")) continue;
  const [a, b] = [channels(getComputedStyle(element).color), behind(element)].map(luminance);
  const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  const name = `${element.tagName} ${element.className}`;
  worst[name] = Math.min(worst[name] ?? 99, ratio);
}
return worst;
"""  # the contrast [WCAG 2] of every element that has text of its own, the least by tag and class
FONTS = """
return [...document.querySelectorAll("body *")].filter((element) => element.getClientRects().length
  && [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim())
  && parseFloat(getComputedStyle(element).fontSize) < 12).map((element) => element.outerHTML.slice(0, 99));
"""


@pytest.fixture(scope="session")
def chrome():
    """One for all pages; each test opens its own."""
    found = [shutil.which(name) for name in NAMES]
    if None in found:
        complaint = "no browser: apt-get install chromium chromium-driver"
        (pytest.fail if os.environ.get("UAVNAV_BROWSER") == "required" else pytest.skip)(complaint)
    options = webdriver.ChromeOptions()
    options.binary_location = found[0]
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    # the path given: nothing is looked for
    driver = webdriver.Chrome(options=options, service=Service(found[1]))
    driver.set_script_timeout(240)  # axe takes a second, and a minute beside ten other processes
    yield driver
    driver.quit()


def forget(browser):
    """Whatever the browser logged before."""
    for kind in ("browser", "performance"):
        browser.get_log(kind)


def complaints(browser):
    """What the console said since."""
    return [one for one in browser.get_log("browser") if one["level"] != "INFO"]


def requested(browser):
    """The addresses that were asked for since."""
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [
        event["params"]["request"]["url"]
        for event in events
        if event["method"] == "Network.requestWillBeSent"
    ]


def resize(browser, width, height=900):
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width == NARROW}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def theme(browser, name, motion="reduce"):
    features = [
        {"name": "prefers-color-scheme", "value": name},
        {"name": "prefers-reduced-motion", "value": motion},
    ]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def unfold(browser):
    """Open whatever a page folds."""
    browser.execute_script("document.querySelectorAll('details').forEach((one) => { one.open = true; })")


def violations(browser, *impacts):
    """What axe finds on the page as it is; impacts: only of these, such as `serious`."""
    browser.execute_script("(0, eval)(arguments[0])", AXE.read_text())
    found = browser.execute_async_script(
        "axe.run(document, {}).then((found) => arguments[arguments.length - 1](found.violations))"
    )
    return [
        (rule["id"], [node["html"][:200] for node in rule["nodes"]])
        for rule in found
        if not impacts or rule["impact"] in impacts
    ]


def find(browser, selector):
    return browser.find_elements(By.CSS_SELECTOR, selector)


def one(browser, selector):
    return browser.find_element(By.CSS_SELECTOR, selector)


def wait(browser, condition, seconds=60):
    return WebDriverWait(browser, seconds, 0.05).until(lambda _: condition())


def press(browser, *keys):
    """To whatever has the focus."""
    webdriver.ActionChains(browser).send_keys(*keys).perform()


def ask(browser, words):
    return browser.execute_script(f"return {words};")


@pytest.fixture(scope="session")
def playground(once):
    """The playground of the committed configurations, in a folder of its own."""

    def make(folder):
        from uavnav.views.browser.playground import collect, page

        (folder / "playground.html").write_text(page(collect([RESULTS / "vectorised"])))

    return once("playground", make) / "playground.html"


@pytest.fixture(scope="module")
def opened(chrome, playground):
    """The same, where the browser is."""
    visit(chrome, playground)
    return playground


def visit(browser, path, fragment="", width=WIDE, colours="light", motion="reduce"):
    """The page, freshly opened; with reduced motion nothing moves by itself."""
    resize(browser, width)
    theme(browser, colours, motion)
    browser.get("about:blank")
    browser.get(path.as_uri() + fragment)

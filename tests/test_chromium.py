"""What the tests' browser tells of requests, without which finding none would mean nothing."""

from pathlib import Path

from chromium import chromium

PAGE = """
<img src="http://elsewhere.invalid/picture.png">
<script>
const ask = "fetch('http://elsewhere.invalid/worker').catch(() => 0).finally(() => postMessage('asked'))"
new Worker(URL.createObjectURL(new Blob([ask]))).onmessage = () => window.asked = true
new WebSocket("ws://elsewhere.invalid/socket")
</script>
"""


def test_the_requests_of_a_page_and_of_its_workers_are_seen(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(PAGE, encoding="utf-8")
    with chromium() as browser:
        browser.page.open((tmp_path / "page.html").as_uri())
        browser.page.until("window.asked === true")
        told = [complaint["entry"]["url"] for complaint in browser.page.complaints if "entry" in complaint]
        asked = browser.quit()
    assert "http://elsewhere.invalid/picture.png" in told
    assert sorted(asked) == [
        "http://elsewhere.invalid/picture.png",
        "http://elsewhere.invalid/worker",
        "ws://elsewhere.invalid/socket",
    ]

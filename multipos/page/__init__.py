"""The program as a page: a static site that runs the package itself in the browser.

Open `site` first.
"""

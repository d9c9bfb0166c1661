"""The viewer link: every edge of the graph in Rerun, on one sensor timeline. Source: DESIGN, Links."""

from links.viewer.screenshot import ViewerMissing, screenshot, show
from links.viewer.viewer import Viewer

__all__ = ["Viewer", "ViewerMissing", "screenshot", "show"]

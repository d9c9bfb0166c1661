"""The viewer link: every edge of the graph in Rerun, on one sensor timeline. Source: DESIGN, Links."""

from links.viewer.viewer import Viewer
from links.viewer.window import ViewerMissing, screenshot, show

__all__ = ["Viewer", "ViewerMissing", "screenshot", "show"]

"""Files of other programs as recordings: captures, MAVLink logs, autopilots' own logs, ROS bags."""

from links.importing.file_kind import FileKind, file_kind
from links.importing.importing import ImportReport, import_file

__all__ = ["FileKind", "ImportReport", "file_kind", "import_file"]

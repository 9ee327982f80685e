"""Places of files: paths of this machine, or URLs of an object store."""

from tauext.store.answers import answers
from tauext.store.fetching import local_beside, local_file, local_folder, local_robot
from tauext.store.named_files import named_files
from tauext.store.place import Place, is_stored, place_of, same_place
from tauext.store.reading import reading, version_of
from tauext.store.staging import added, at_home, in_order, put, send_folder, staged, written_as
from tauext.store.stored import StoredPlace

__all__ = [
    "Place",
    "StoredPlace",
    "added",
    "answers",
    "at_home",
    "in_order",
    "is_stored",
    "local_beside",
    "local_file",
    "local_folder",
    "local_robot",
    "named_files",
    "place_of",
    "put",
    "reading",
    "same_place",
    "send_folder",
    "staged",
    "version_of",
    "written_as",
]

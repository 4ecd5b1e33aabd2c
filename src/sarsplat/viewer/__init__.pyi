from .subject import Subject as Subject
from .subject import subject_at as subject_at
from .viewer import Viewer as Viewer
from .viewer import watched as watched

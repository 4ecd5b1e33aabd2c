from .run_subject import subject_at as subject_at
from .subject import Subject as Subject
from .viewer import Viewer as Viewer
from .viewer import watched as watched

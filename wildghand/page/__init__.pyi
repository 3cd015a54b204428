from .write import PageFacts as PageFacts
from .write import PageSettings as PageSettings
from .write import show_page as show_page
from .write import write_page as write_page

"""One HTML page about a fit, complete in itself: pictures, parameters, what is not known."""

from .show.fit_page import page as page, write as write

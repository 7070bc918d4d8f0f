"""One self-contained HTML page about a fit: pictures, parameters, open questions."""

from .show.fit_page import page as page, write as write

"""The desk: live views of a telescope in a browser. Panel and Bokeh (``pachon[desk]``) are imported when it opens."""

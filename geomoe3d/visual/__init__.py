"""How a registration is shown: a picture for a report, a page to turn it in a browser, a window.

All three take one `view.RegistrationView`. `picture.save_picture` needs matplotlib and no display,
`page.save_page` needs nothing but the standard library and numpy, `window.show_window` needs Open3D and a
display. Nothing here changes a number of the result.
"""

from geomoe3d.runtime.home import ensure_font_cache

ensure_font_cache()

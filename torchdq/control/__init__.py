"""Control laws, each declared once: function, layer, controller of a scene and program follow from it."""

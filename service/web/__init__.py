"""Web pages: rendered here, with htmx, uPlot and a three.js viewer as static files."""

from fastapi import FastAPI


def mount_pages(app: FastAPI) -> None:
    """Add the pages and their static files to the application."""
    from octasplat.service.web import api_page, job_list, overview_pages, pages, session
    from octasplat.service.web.assets import StaticAssets
    from octasplat.service.web.documentation import DocumentationSite
    from octasplat.service.web.routing import UnknownPage

    app.include_router(session.router)
    app.include_router(overview_pages.router)
    app.include_router(job_list.router)
    app.include_router(pages.router)
    app.include_router(api_page.router)
    app.mount("/static", StaticAssets(), name="static")
    app.mount("/documentation", DocumentationSite(), name="documentation")
    app.router.routes.append(UnknownPage())

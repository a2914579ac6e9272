"""Pages of the list of jobs: filters, and tokens that belong to one list."""

import base64
import binascii
import hashlib
import re
from datetime import datetime
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from vergence_proto.errors import BadShape
from vergence_proto.jobs import JobState
from vergence_service.jobs.job import Job

LABEL = r"^[^:=\s]{1,64}:.{0,200}$"


# RFC 3339, section 5.6. pydantic alone would take numbers for seconds, and days without a time.
_DATE_TIME = re.compile(r"\d{4}-\d\d-\d\d[Tt]\d\d:\d\d:\d\d(\.\d+)?([Zz]|[+-]\d\d:\d\d)", re.ASCII)


def _date_time(value: object) -> object:
    if not _DATE_TIME.fullmatch(str(value)):
        raise ValueError("expected a date and time with its zone, as in 2026-01-31T12:00:00Z")
    return value


class ListQuery(BaseModel):
    """The filters and the page of a list."""

    model_config = ConfigDict(extra="forbid")

    state: list[JobState] = Field(default=[], description="only jobs in these states")
    name: str | None = Field(default=None, max_length=200, description="only jobs of this name")
    label: list[Annotated[str, Field(pattern=LABEL)]] = Field(
        default=[], description="only jobs with all these labels, KEY:VALUE"
    )
    created_after: Annotated[datetime, BeforeValidator(_date_time)] | None = Field(
        default=None, description="only jobs created since"
    )
    page_size: int = Field(default=100, ge=1, le=1000, description="most jobs of a page")
    page_token: str = Field(
        default="", max_length=200, description="of the link `next` of an earlier page"
    )

    def wants(self, job: Job) -> bool:
        """Return whether the list has this job."""
        if self.state and job.state not in self.state:
            return False
        if self.name is not None and job.name != self.name:
            return False
        theirs = {f"{key}:{value}" for key, value in job.labels.items()}
        if not theirs.issuperset(self.label):
            return False
        return self.created_after is None or job.created_s >= self.created_after.timestamp()

    def below(self) -> int | None:
        """Return where the page begins. Raises BadShape: the token is of another list."""
        if not self.page_token:
            return None
        try:
            serial, _, mark = base64.urlsafe_b64decode(self.page_token).decode().partition(".")
            if mark == self._mark():
                return int(serial)
        except (binascii.Error, UnicodeError, ValueError):
            pass
        raise BadShape(
            "the page_token is not one of this list; begin without it, with the filters unchanged "
            "from page to page"
        )

    def token(self, below: int) -> str:
        """Return the token of the page that begins there."""
        return base64.urlsafe_b64encode(f"{below}.{self._mark()}".encode()).decode()

    def _mark(self) -> str:
        filters = self.model_dump_json(exclude={"page_token", "page_size"})
        return hashlib.sha256(filters.encode()).hexdigest()[:16]

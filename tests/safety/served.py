"""The service's core without a bus: requests go in, replies come out."""

import numpy as np

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.service.client import read_reply, request_message
from brakeline.safety.service.filter_client import accept
from brakeline.safety.service.plan_token import PlanAuthenticator
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts


class Service:
    """The service's core. With a key, it checks plan tokens."""

    def __init__(self, *models, archive=None, key=None):
        self.models, self.counts = ModelRegistry(archive, accept_bound=1.0), ServiceCounts()
        for model in models:
            self.models.install(model)
        self.answer = BatchHandler(self.models, self.counts, None if key is None else PlanAuthenticator(key))

    def replies(self, *requests):
        payload = pb.RequestBatch(requests=requests).SerializeToString()
        return list(pb.ReplyBatch.FromString(self.answer(payload)).replies)

    def decision(self, request):
        return self.replies(request)[0].decision

    def error(self, request):
        reply = self.replies(request)[0]
        assert reply.WhichOneof("result") == "error"
        return reply.error


def with_fields(message, **values):
    """Return the message after its fields were set; a list has all elements of a field."""
    for name, value in values.items():
        if isinstance(value, list):
            message.ClearField(name)
            getattr(message, name).extend(value)
        else:
            setattr(message, name, value)
    return message


class ServiceClient:
    """A client of such a service, with one robot's backup plan."""

    def __init__(self, model, **service):
        self.service, self.robot = Service(model, **service), model.robot
        self.backup_plan = BackupPlan(model.robot)

    def decide(self, state, action, obstacles=None, **more):
        request = request_message(self.backup_plan, np.asarray(state, float), action, obstacles, **more)
        answer = read_reply(self.service.replies(request)[0], request, self.robot)
        accept(self.backup_plan, answer)
        return answer

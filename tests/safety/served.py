"""The service's core without a bus: requests go in, replies come out."""

from brakeline.messaging import brakeline_pb2 as pb
from brakeline.safety.service.client import SafetyClient
from brakeline.safety.service.plan_token import PlanAuthenticator
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts


class Service:
    """The service's core. With a key, it checks plan tokens."""

    def __init__(self, *models, archive=None, key=None):
        self.models, self.counts = ModelRegistry(archive, accept_bound=1.0), ServiceCounts()
        for model in models:
            self.models.install(model)
        self.answer = BatchHandler(self.models, self.counts, None if key is None else PlanAuthenticator(key))

    def ask(self, topic, payload, *_, **__):
        """Answer a client that takes the service for its bus."""
        return self.answer(payload)

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


class ServiceClient(SafetyClient):
    """A client of such a service, without a bus."""

    def __init__(self, model, **service):
        self.service = Service(model, **service)
        super().__init__(self.service, model.robot)
